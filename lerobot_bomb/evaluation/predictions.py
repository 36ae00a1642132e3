"""Predictions of a policy on recorded frames: its losses, and the actions that it decodes.

Shapes: `R` frames, `B` of them in a batch, `T` actions of a chunk, `D` action dims.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.policies import PreTrainedPolicy, get_policy_class
from lerobot.utils.constants import ACTION
from lerobot.utils.feature_utils import dataset_to_policy_features
from torch import Tensor
from torch.utils.data import DataLoader, Subset
from tqdm import tqdm

from lerobot_bomb.checkpoints.folder import Postprocessor, Preprocessor, autocast, load_processors

LOSS = "loss"


@dataclass(frozen=True)
class Predictions:
    """Predictions of a policy on R frames."""

    losses: dict[str, np.ndarray]  # {name: (R,)}, NaN where a frame has none
    chunks: np.ndarray  # (R, T, D) decoded actions in the dataset's units


def check_policy(config: PreTrainedConfig, meta: LeRobotDatasetMetadata, rename_map: dict[str, str]) -> None:
    """Raise a ValueError unless the dataset has all that the policy reads, and the policy predicts chunks."""
    features = {
        rename_map.get(key, key): feature
        for key, feature in dataset_to_policy_features(meta.features).items()
    }
    for key, wanted in {**(config.input_features or {}), **(config.output_features or {})}.items():
        if key not in features:
            raise ValueError(
                f"the policy needs {key!r}, which dataset {meta.repo_id} has not; it has {sorted(features)}"
            )
        has = tuple(features[key].shape)
        if wanted.type.name != "VISUAL" and has != tuple(wanted.shape):
            raise ValueError(
                f"the policy has {key!r} of shape {tuple(wanted.shape)}; dataset {meta.repo_id} has {has}"
            )
    indices = config.action_delta_indices
    if indices is None and getattr(config, "chunk_size", None) == 1:
        indices = [0]  # see `action_deltas`
    if (
        not indices
        or indices != list(range(len(indices)))
        or len(config.observation_delta_indices or [0]) > 1
    ):
        raise ValueError(
            f"policy type {config.type}: only policies that predict a chunk of actions from one observation "
            f"can be measured (its action steps: {indices}, observation steps: "
            f"{config.observation_delta_indices})"
        )
    if config.use_peft:
        raise ValueError(
            "the checkpoint holds adapters; lerobot-bomb checkpoint merge makes a whole one of them and "
            "their base"
        )


def load_network(config: PreTrainedConfig) -> PreTrainedPolicy:
    """Load the checkpoint's network on the config's device, for evaluation."""
    policy = get_policy_class(config.type).from_pretrained(str(config.pretrained_path), config=config)
    return policy.to(str(config.device)).eval()


def load_dataset(
    config: PreTrainedConfig, meta: LeRobotDatasetMetadata, episodes: list[int]
) -> LeRobotDataset:
    """Load some episodes, each frame with the actions that follow it, as lerobot-train reads them."""
    return LeRobotDataset(
        meta.repo_id,
        root=meta.root,
        episodes=episodes,
        delta_timestamps=resolve_delta_timestamps(config, meta),
    )


def predict(
    policy: PreTrainedPolicy, dataset: LeRobotDataset, rows_R: np.ndarray, batch_size: int, title: str
) -> Predictions:
    """Compute losses and decoded chunks for these rows of the dataset."""
    preprocess, postprocess = load_processors(policy.config)
    loader = DataLoader(Subset(dataset, rows_R.tolist()), batch_size=batch_size)
    losses, chunks = [], []
    with torch.no_grad(), autocast(policy.config), tqdm(total=len(rows_R), desc=title, disable=None) as bar:
        for batch in loader:
            num_frames = len(batch["index"])
            losses += [_losses(policy, preprocess, _row(batch, i)) for i in range(num_frames)]
            chunks.append(_decode(policy, preprocess, postprocess, batch))
            bar.update(num_frames)
    names = dict.fromkeys(name for row in losses for name in row)
    values = {name: np.array([row.get(name, np.nan) for row in losses]) for name in names}
    chunks_RTD = np.concatenate(chunks)
    if not (np.isfinite(values[LOSS]).all() and np.isfinite(chunks_RTD).all()):
        raise ValueError("the policy's loss or an action of it is not a finite number; did training diverge?")
    return Predictions({name: x for name, x in values.items() if np.isfinite(x).any()}, chunks_RTD)


def _row(batch: dict[str, Any], row: int) -> dict[str, Any]:
    """Return one row as a batch of one."""
    return {key: values[row : row + 1] for key, values in batch.items()}


def _losses(policy: PreTrainedPolicy, preprocess: Preprocessor, frame: dict[str, Any]) -> dict[str, float]:
    """Compute loss and sub-losses of one frame, alone, so that no other frame in a batch weighs in."""
    torch.manual_seed(int(frame["index"]))  # policies that draw noise draw the same in every run
    loss, sub_losses = policy.forward(preprocess(frame))
    return {LOSS: float(loss), **{name: float(x) for name, x in (sub_losses or {}).items() if _is_number(x)}}


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.number) or (isinstance(value, Tensor) and value.numel() == 1)


def _decode(
    policy: PreTrainedPolicy, preprocess: Preprocessor, postprocess: Postprocessor, batch: dict[str, Any]
) -> np.ndarray:
    """(B, T, D) actions in the dataset's units; the policy is not shown the recorded ones."""
    observation = {key: values for key, values in batch.items() if not key.startswith(ACTION)}
    torch.manual_seed(int(batch["index"][0]))
    policy.reset()
    chunk_BTD = policy.predict_action_chunk(preprocess(observation))
    actions = [postprocess(actions_BD) for actions_BD in chunk_BTD.unbind(dim=1)]
    return torch.stack(actions, dim=1).float().cpu().numpy()
