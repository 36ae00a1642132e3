"""``keypoint_probe``: where things are in the images, what the arm feels, what the instruction says.

Source of the keypoints: the spatial softmax of Finn et al. (2016), "Deep spatial autoencoders for
visuomotor learning".

Shapes: `B` batch, `K` keypoints of a camera, `H` and `W` of its heat maps, `S` state dims, `D` action dims,
`L` words of an instruction.
"""

from typing import Any

import torch
from lerobot.utils.constants import ACTION, OBS_LANGUAGE_TOKENS, OBS_STATE
from torch import Tensor, nn

from lerobot_bomb.hub.method import Method, Paper
from lerobot_bomb.policies.policy import ChunkPolicy
from lerobot_policy_keypoint_probe.configuration_keypoint_probe import GROUP_CHANNELS, KeypointProbeConfig
from lerobot_policy_keypoint_probe.processor_keypoint_probe import NO_WORD, NUM_WORD_IDS


class KeypointEncoder(nn.Module):
    """(B, 3, H, W) in [0, 1] -> (B, 3K): x and y of each keypoint in [-1, 1], and how clear it is."""

    def __init__(self, num_keypoints: int, num_channels: int, initial_sharpness: float):
        super().__init__()
        wide = 2 * num_channels
        self.layers = nn.Sequential(
            *_convolution(3, num_channels, kernel=5, stride=2),
            *_convolution(num_channels, wide, kernel=3, stride=2),
            *_convolution(wide, wide, kernel=3, stride=1),
            nn.Conv2d(wide, num_keypoints, 3, padding=1),
        )
        self.sharpness = nn.Parameter(torch.full((num_keypoints, 1, 1), initial_sharpness))

    def forward(self, image_B3HW: Tensor) -> Tensor:
        heat_BKHW = self.sharpness * self.layers(2 * image_B3HW - 1)
        share_BKHW = heat_BKHW.flatten(2).softmax(dim=-1).view_as(heat_BKHW)
        clarity_BK = (share_BKHW * heat_BKHW).sum(dim=(2, 3)) / 10  # of the size of the coordinates
        return torch.cat([_mean_place(share_BKHW.sum(2)), _mean_place(share_BKHW.sum(3)), clarity_BK], dim=1)


SHAPES = ("num_keypoints", "num_channels", "num_state_octaves", "word_dim", "hidden_dim")


class KeypointProbePolicy(ChunkPolicy):
    """Predicts one action per observation; keeps nothing between steps."""

    method = Method(
        "keypoints of every camera, the robot's state and a bag of the instruction's words, through two "
        "hidden layers: a probe that asks what demonstrations teach.",
        papers=(
            Paper(
                "finn2016deep",
                "Deep spatial autoencoders for visuomotor learning",
                "Finn, Chelsea and others",
                2016,
                "1509.06113",
            ),
        ),
    )
    shapes = SHAPES
    as_trained = (*SHAPES, "normalization_mapping")
    config_class = KeypointProbeConfig  # pyright: ignore[reportAssignmentType]  LeRobot annotates it as None
    name = "keypoint_probe"  # pyright: ignore[reportAssignmentType]
    config: KeypointProbeConfig

    def __init__(self, config: KeypointProbeConfig, dataset_meta: Any = None, **_: object):
        super().__init__(config, dataset_meta)
        assert config.robot_state_feature is not None
        self.encoders = nn.ModuleList(
            KeypointEncoder(config.num_keypoints, config.num_channels, config.initial_sharpness)
            for _ in self._cameras
        )
        self.words = nn.EmbeddingBag(NUM_WORD_IDS, config.word_dim, mode="sum", padding_idx=NO_WORD)
        num_inputs = 3 * config.num_keypoints * len(self._cameras) + config.word_dim
        num_inputs += config.robot_state_feature.shape[0] * (1 + 2 * config.num_state_octaves)
        hidden = config.hidden_dim
        self.head = nn.Sequential(
            nn.Linear(num_inputs, hidden),
            nn.ReLU(),
            nn.Linear(hidden, hidden),
            nn.ReLU(),
            nn.Linear(hidden, self.action_dim),
        )

    def forward(self, batch: dict[str, Tensor], reduction: str = "mean") -> tuple[Tensor, dict[str, float]]:
        """Mean absolute error of the normalised actions; ``reduction="none"`` gives (B,)."""
        errors_BD = (self._act(batch) - batch[ACTION]).abs()
        return errors_BD.mean(dim=1) if reduction == "none" else errors_BD.mean(), {}

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **_: object) -> Tensor:
        """(B, D) next normalised action."""
        self.eval()
        return self._act(batch)

    def predict_action_chunk(self, batch: dict[str, Tensor], **_: object) -> Tensor:
        """(B, 1, D) normalised actions."""
        return self.select_action(batch)[:, None]

    def _act(self, batch: dict[str, Tensor]) -> Tensor:
        """(B, D) normalised action."""
        keypoints = [
            encoder(batch[camera]) for camera, encoder in zip(self._cameras, self.encoders, strict=True)
        ]
        state_BS = batch[OBS_STATE]
        octaves = 2.0 ** torch.arange(self.config.num_state_octaves, device=state_BS.device)
        phases = (torch.pi / 2 * state_BS[..., None] * octaves).flatten(1)
        instruction = self.words(batch[OBS_LANGUAGE_TOKENS])
        return self.head(torch.cat([*keypoints, state_BS, phases.sin(), phases.cos(), instruction], dim=1))


def _convolution(channels_in: int, channels_out: int, kernel: int, stride: int) -> list[nn.Module]:
    return [
        nn.Conv2d(channels_in, channels_out, kernel, stride, padding=kernel // 2),
        nn.GroupNorm(channels_out // GROUP_CHANNELS, channels_out),
        nn.ReLU(),
    ]


def _mean_place(share_BKN: Tensor) -> Tensor:
    """(B, K, N) shares that sum to 1 -> (B, K) mean place between -1, the first, and 1, the last."""
    return share_BKN @ torch.linspace(-1, 1, share_BKN.shape[-1], device=share_BKN.device)
