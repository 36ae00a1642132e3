"""LeRobot's real-time chunking on our samplers: a new chunk continues the rest of the last one.

LeRobot's time runs from 1 (noise) to 0 (actions), and its velocity points to the noise.
Shapes: `B` batch, `K` action steps, `D` action dims.
"""

import torch
from lerobot.policies.rtc import RTCProcessor
from torch import Tensor

from lerobot_bomb.flow.samplers import Heads, Predicted


def without_padding(leftover_KD: Tensor) -> Tensor:
    """Return the actions without the zeros that lerobot-rollout appends up to its execution horizon.

    Zeros would guide a chunk to the mean action, and a horizon beyond the chunk is an error.
    """
    is_action_K = leftover_KD.any(dim=-1).reshape(-1, leftover_KD.shape[-2]).any(dim=0)
    num_actions = int(is_action_K.nonzero().max()) + 1 if is_action_K.any() else 0
    return leftover_KD[..., :num_actions, :]


def guided(
    heads: Heads,
    processor: RTCProcessor,
    leftover_KD: Tensor,
    inference_delay: int,
    execution_horizon: int | None = None,
) -> Heads:
    """Return heads whose velocity leads to the normalised leftover actions, (B, K, D) or (K, D).

    The noise is changed alike, so that the heads disagree as before: otherwise `residual` would undo part of
    the guidance. Without leftover actions, the heads are returned unchanged.
    """
    if leftover_KD.shape[-2] == 0:
        return heads

    def guided_heads(actions_BKD: Tensor, tau_B: Tensor) -> Predicted:
        predicted: list[Predicted] = []

        def velocity_to_noise(actions_BKD: Tensor) -> Tensor:
            with torch.no_grad():  # the guidance is a gradient with respect to the actions alone
                predicted.append(heads(actions_BKD, tau_B))
            velocity_BKD, _ = predicted[-1]
            assert velocity_BKD is not None
            return -velocity_BKD.float()

        guided_BKD = processor.denoise_step(
            x_t=actions_BKD,
            prev_chunk_left_over=leftover_KD,
            inference_delay=inference_delay,
            time=1 - tau_B[:, None, None],
            original_denoise_step_partial=velocity_to_noise,
            execution_horizon=execution_horizon,
        )
        velocity_BKD, noise_BKD = predicted[-1]
        assert velocity_BKD is not None
        guided_BKD = -guided_BKD.detach()
        if noise_BKD is not None:  # a velocity that is larger by d implies a noise that is smaller by tau d
            noise_BKD = noise_BKD.float() - tau_B[:, None, None] * (guided_BKD - velocity_BKD.float())
        return guided_BKD, noise_BKD

    return guided_heads
