"""Export a shipped `fdvla` for the page of `make_play.py`: a graph in ONNX, the tokenizer, sampling noise.

The graph is a whole query: images in [0, 1] and the state in; actions out, in the environment's units.
"""

import json
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.constants import (
    ACTION,
    OBS_IMAGES,
    OBS_LANGUAGE_ATTENTION_MASK,
    OBS_LANGUAGE_TOKENS,
    OBS_STATE,
)
from play_episodes import most_steps
from torch import Tensor, nn

from lerobot_bomb.bomb.observation import CAMERAS, STATE_DIM
from lerobot_bomb.checkpoints.folder import Postprocessor, Preprocessor, load_processors, read_config
from lerobot_bomb.checkpoints.shipped import shipped_checkpoint
from lerobot_bomb.evaluation.predictions import load_network
from lerobot_bomb.vlm.task_tokenizer import TaskTokenizerStep
from lerobot_policy_bomb.fdvla import modeling_fdvla

INPUTS = ("images", "state", "ids", "mask", "noise")
NOISE_DIGITS = 7


class Query(nn.Module):
    """Observation -> actions (K, D), as an evaluation queries the policy."""

    state_mean: Tensor
    state_std: Tensor
    action_mean: Tensor
    action_std: Tensor

    def __init__(self, policy: Any, before: Any, after: Any):
        super().__init__()
        self.policy = policy
        normalizer, unnormalizer = before.steps[-1], after.steps[0]
        self._eps = normalizer.eps
        for name, step, key in (("state", normalizer, OBS_STATE), ("action", unnormalizer, ACTION)):
            for statistic in ("mean", "std"):
                self.register_buffer(f"{name}_{statistic}", step._tensor_stats[key][statistic])

    def forward(
        self, images_C3HW: Tensor, state_1S: Tensor, ids_1L: Tensor, mask_1L: Tensor, noise_1KD: Tensor
    ) -> Tensor:
        """Take images of all cameras, state, the instruction's tokens with a mask, and noise."""
        batch = {f"{OBS_IMAGES}.{camera}": images_C3HW[i : i + 1] for i, camera in enumerate(CAMERAS)}
        batch[OBS_STATE] = (state_1S - self.state_mean) / (self.state_std + self._eps)
        batch |= {OBS_LANGUAGE_TOKENS: ids_1L, OBS_LANGUAGE_ATTENTION_MASK: mask_1L}
        context = self.policy._read(batch)
        if self.policy.pointer is not None:
            context = self.policy._pointing(context, batch[OBS_STATE])
        no_noise = noise_1KD.new_zeros(1, 0, *noise_1KD.shape[1:])  # that only the sampler `sde` adds
        (actions_1KD,) = self.policy._sample(noise_1KD, no_noise, *context.tensors())
        return actions_1KD[0] * self.action_std + self.action_mean


def load(name: str) -> tuple[PreTrainedPolicy, Preprocessor, Postprocessor]:
    """Load a shipped policy and its processors."""
    config = read_config(shipped_checkpoint(name), "cpu")
    return load_network(config), *load_processors(config)


def example(query: Query, ids: list[int], num_tokens: int) -> tuple[Tensor, ...]:
    """Return inputs of a query with an instruction that is padded to `num_tokens`."""
    config = query.policy.config
    side = config.image_features[f"{OBS_IMAGES}.{CAMERAS[0]}"].shape[-1]
    padded = torch.zeros(1, num_tokens, dtype=torch.int64)
    padded[0, : len(ids)] = torch.tensor(ids)
    images = torch.rand(len(CAMERAS), 3, side, side)
    mask = torch.arange(num_tokens)[None] < len(ids)
    noise = torch.randn(1, config.chunk_size, query.policy.action_dim)
    return images, torch.zeros(1, STATE_DIM), padded, mask, noise


@contextmanager
def traceable(policy: Any) -> Iterator[None]:
    """Replace what looks at numbers while a graph is traced, but is the same in every query."""
    assert policy.config.crop_fraction == 1, "the whole image"
    backbone = policy.backbone
    visual, side = backbone.vlm.model.visual, backbone.tokens_per_side * backbone._merge
    grid_13 = torch.tensor([[1, side, side]])
    (window_index, ends), angles = visual.get_window_index(grid_13), visual.rot_pos_emb(grid_13).detach()
    windows = window_index, [int(end) for end in ends]
    constant = {
        (visual, "get_window_index"): lambda _: windows,
        (visual, "rot_pos_emb"): lambda _: angles,
        (modeling_fdvla, "crop"): lambda images, *_: images,
    }
    with ExitStack() as stack:
        stack.enter_context(patch("lerobot_bomb.vlm.inputs.require_finite_batch", lambda *_: None))
        for (owner, name), replacement in constant.items():
            stack.enter_context(patch.object(owner, name, replacement))
        yield


def export(name: str, instructions: set[str], folder: Path) -> None:
    """Write graph and `policy.json` of a policy that can read all these instructions."""
    policy, before, after = load(name)
    query = Query(policy, before, after).eval()
    tokenizer_step: Any = next(step for step in before.steps if isinstance(step, TaskTokenizerStep))
    longest = max((tokenizer_step._ids_of(text).tolist() for text in instructions), key=len)
    inputs = example(query, longest, len(longest))
    with torch.no_grad(), traceable(query.policy):
        query(*inputs)  # fills caches, which would else hold what tracing puts there
        graph = torch.onnx.export(
            query,
            inputs,
            dynamo=True,
            opset_version=18,
            input_names=INPUTS,
            output_names=["actions"],
            verbose=False,
        )
    assert graph is not None
    graph.save(folder / "policy.onnx", external_data=False)
    config = query.policy.config
    shape = 1, config.chunk_size, query.policy.action_dim
    noise = []
    for _ in range(most_steps()):
        noise.append(query.policy._noise(None, shape))
        query.policy._step_noise(shape)
    assert tokenizer_step.tokenizer is not None
    model = json.loads(tokenizer_step.tokenizer.to_str())["model"]
    record = {
        "image_size": config.environment.image_size,
        "num_tokens": len(longest),
        "vocab": model["vocab"],
        "merges": [pair if isinstance(pair, str) else " ".join(pair) for pair in model["merges"]],
        "noise": [[round(number, NOISE_DIGITS) for number in each.flatten().tolist()] for each in noise],
    }
    (folder / "policy.json").write_text(json.dumps(record, separators=(",", ":")))
