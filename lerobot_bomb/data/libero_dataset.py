"""Episodes of LIBERO's scripted expert as those of a LeRobotDataset."""

import json
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from lerobot.processor.env_processor import LiberoProcessorStep
from lerobot.utils.constants import ACTION, OBS_PREFIX, OBS_STATE

from lerobot_bomb import __version__
from lerobot_bomb.data.blocks import RecordedEpisode
from lerobot_bomb.data.libero_conversion import KEYS
from lerobot_bomb.data.libero_recording import IMAGE_NAMES, LiberoRollout


def libero_episode(rollout: LiberoRollout) -> RecordedEpisode:
    """Convert a rollout to the episode that the dataset stores."""
    images = zip(*(rollout.frames[name] for name in IMAGE_NAMES), strict=True)
    frames = (
        {**dict(zip(KEYS, pair, strict=True)), OBS_STATE: state, ACTION: action, "task": rollout.instruction}
        for pair, state, action in zip(images, _states(rollout), rollout.actions, strict=True)
    )
    spec = rollout.result.spec
    columns = {
        "bomb/seed": spec.seed,
        "bomb/levels": json.dumps(rollout.result.levels),
        "bomb/spec": json.dumps(asdict(spec)),
        "bomb/protocol_version": rollout.result.protocol_version,
        "bomb/package_version": __version__,
    }
    return RecordedEpisode(frames, columns)


def _states(rollout: LiberoRollout) -> np.ndarray:
    """(T, 8) float32, the states that LeRobot's processor gives a policy."""
    eef, gripper = ([state[name] for state in rollout.robot_states] for name in ("eef", "gripper"))
    batch: dict[str, Any] = {
        "eef": {name: torch.from_numpy(np.stack([each[name] for each in eef])) for name in ("pos", "quat")},
        "gripper": {"qpos": torch.from_numpy(np.stack([each["qpos"] for each in gripper]))},
    }
    return LiberoProcessorStep().observation({f"{OBS_PREFIX}robot_state": batch})[OBS_STATE].numpy()
