"""Rollouts as episodes of a LeRobotDataset: its features, frames and columns."""

import json
from typing import Any

import numpy as np
from lerobot.utils.constants import ACTION, DONE, OBS_IMAGES, OBS_PREFIX, OBS_STATE

from lerobot_bomb import __version__
from lerobot_bomb.bomb.environment import robot_type
from lerobot_bomb.bomb.observation import ACTION_NAMES, CAMERAS, geometry_shapes, state_names
from lerobot_bomb.bomb.pointing import COLUMNS
from lerobot_bomb.data.blocks import DatasetLayout, RecordedEpisode
from lerobot_bomb.data.recording import Recording
from lerobot_bomb.data.rollout_pool import Rollout
from lerobot_bomb.results.bomb import EpisodeResult


def rollout_layout(recording: Recording) -> DatasetLayout:
    """Return the layout, with the keys under which a policy sees BOMB; never `environment_state`."""
    size = recording.image_size
    dtype = "image" if recording.images else "video"
    image = {"dtype": dtype, "shape": (size, size, 3), "names": ["height", "width", "channels"]}
    names = {ACTION: ACTION_NAMES[recording.control_mode], OBS_STATE: state_names(recording.control_mode)}
    # arrays, not images: a policy would take images of depth, intrinsics and extrinsics for cameras
    geometry = {
        f"{OBS_PREFIX}{key}": {"dtype": "float32", "shape": shape, "names": ["row", "column"]}
        for key, shape in geometry_shapes(recording.render_options).items()
    }
    pointing = {
        f"{OBS_PREFIX}{name}": {"dtype": "float32", "shape": (len(numbers),), "names": list(numbers)}
        for name, numbers in (COLUMNS if recording.pointing else {}).items()
    }
    features = {
        **{f"{OBS_IMAGES}.{camera}": dict(image) for camera in CAMERAS},
        **{
            key: {"dtype": "float32", "shape": (len(names[key]),), "names": list(names[key])}
            for key in (OBS_STATE, ACTION)
        },
        **geometry,
        **pointing,
        # True where no action of the same episode follows: a scene belongs to no other
        **({DONE: {"dtype": "bool", "shape": (1,), "names": None}} if recording.pointing else {}),
    }
    return DatasetLayout(
        recording.repo_id,
        recording.fps,
        robot_type(recording.robot, recording.task),
        features,
        not recording.images,
        tuple(geometry),
    )


def rollout_episode(rollout: Rollout) -> RecordedEpisode:
    """Convert a rollout to the episode that the dataset stores."""
    is_scene = rollout.result.steps == 0  # nothing has been run
    frames = (_frame(rollout, step, is_scene) for step in range(rollout.num_steps))
    return RecordedEpisode(frames, _columns(rollout.result))


def _frame(rollout: Rollout, step: int, is_scene: bool) -> dict[str, Any]:
    is_last = is_scene or step == rollout.num_steps - 1
    return {
        **({DONE: np.array([is_last])} if rollout.pointing else {}),
        **{f"{OBS_IMAGES}.{camera}": frames[step] for camera, frames in rollout.frames.items()},
        **{f"{OBS_PREFIX}{key}": values[step] for key, values in rollout.geometry.items()},
        **{f"{OBS_PREFIX}{key}": values[step] for key, values in rollout.pointing.items()},
        OBS_STATE: rollout.states[step],
        ACTION: rollout.actions[step],
        "task": rollout.instructions[step],
    }


def _columns(result: EpisodeResult) -> dict[str, Any]:
    return {
        "bomb/seed": result.spec.seed,
        "bomb/target": list(result.target or ()),
        "bomb/color": result.color or "",
        "bomb/levels": json.dumps(result.levels),
        "bomb/spec": json.dumps(result.spec.to_dict()),
        "bomb/protocol_version": result.task_version,
        "bomb/package_version": __version__,
    }
