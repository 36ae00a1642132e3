"""Answers of checkpoints and a dataset in a folder; `python saved_actions.py FOLDER` writes them beside it.

Only names of LeRobot's, so that it runs with any version of this package.
"""

import hashlib
import sys
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset
from lerobot.envs import make_env_config
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.utils.import_utils import register_third_party_plugins

REPO_ID = "test/before"
EXPECTED = "expected.npz"
NUM_FRAMES = 6  # that a policy acts on, from each episode's start


def read_dataset(root: Path) -> LeRobotDataset:
    return LeRobotDataset(REPO_ID, root=root, video_backend="pyav")


def actions_of(checkpoint: Path, dataset: LeRobotDataset) -> np.ndarray:
    """(E, F, D) physical actions on the first frames of every episode, as lerobot-eval asks for them."""
    register_third_party_plugins()
    config = PreTrainedConfig.from_pretrained(checkpoint, cli_overrides=["--device=cpu"])
    config.pretrained_path = checkpoint
    image_size = dataset.meta.features[dataset.meta.camera_keys[0]]["shape"][0]
    policy = make_policy(config, env_cfg=make_env_config("bomb", image_size=image_size)).eval()
    preprocessor, postprocessor = make_pre_post_processors(config, pretrained_path=str(checkpoint))
    assert dataset.meta.episodes is not None
    episodes = []
    for start in dataset.meta.episodes["dataset_from_index"]:
        policy.reset()
        frames: list[Any] = [dataset[start + number] for number in range(NUM_FRAMES)]
        for frame in frames:
            del frame["action"]
        episodes.append([postprocessor(policy.select_action(preprocessor(frame)))[0] for frame in frames])
    return np.array(episodes, dtype=np.float32)


def contents_of(dataset: LeRobotDataset) -> dict[str, np.ndarray]:
    """{key: all frames of it}; of a camera the SHA-256 of its decoded pixels, (N, 3, S, S) uint8."""
    frames: list[Any] = [dataset[index] for index in range(len(dataset))]
    contents = {
        key: np.stack([frame[key].numpy() for frame in frames]) for key in ("observation.state", "action")
    }
    for camera in dataset.meta.camera_keys:
        pixels = np.stack([(255 * frame[camera].numpy()).round().astype(np.uint8) for frame in frames])
        contents[camera] = np.array(hashlib.sha256(pixels.tobytes()).hexdigest())
    contents["task"] = np.array([frame["task"] for frame in frames])
    return contents


def main(folder: Path) -> None:
    dataset = read_dataset(folder / "dataset")
    actions = {
        path.parent.name: actions_of(path.parent, dataset) for path in sorted(folder.glob("*/config.json"))
    }
    arrays: Any = {**contents_of(dataset), **actions}
    np.savez_compressed(folder / EXPECTED, **arrays)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
