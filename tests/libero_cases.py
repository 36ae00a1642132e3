"""Files of LIBERO's layout, as its scripts/create_dataset.py writes them: observed after the actions."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

REPO_ID = "test/libero"
SUITE = "libero_spatial"
TASK = "pick_up_the_black_bowl_on_the_stove_and_place_it_on_the_plate"
INSTRUCTION = "pick up the black bowl on the stove and place it on the plate"
IMAGE_SIZE = 64
CAMERAS = ("agentview_rgb", "eye_in_hand_rgb")


@dataclass(frozen=True)
class Demonstration:
    """An episode of T actions as a simulator saw it: before each action, and after the last."""

    images: tuple[np.ndarray, np.ndarray]  # each (T + 1, H, W, 3), as OpenGL gives them
    poses: np.ndarray  # (T + 1, 6): metres, axis-angle
    joints: np.ndarray  # (T + 1, 7)
    fingers: np.ndarray  # (T + 1, 2)
    actions: np.ndarray  # (T, 7)
    simulator: np.ndarray | None = None  # (T + 1, n) states; None: of the time, joints and fingers only

    @classmethod
    def drawn(cls, seed: int, num_actions: int = 6) -> "Demonstration":
        """An arm that wanders and closes its gripper half way."""
        rng = np.random.default_rng(seed)
        actions = rng.uniform(-1, 1, (num_actions, 7))
        actions[:, 6] = np.where(np.arange(num_actions) < num_actions // 2, -1, 1)
        opening = 0.04 - 0.005 * np.cumsum([0, *(actions[:, 6] > 0)])
        smooth = rng.integers(0, 256, (2, num_actions + 1, 4, 4, 3), dtype=np.uint8)
        images = smooth.repeat(IMAGE_SIZE // 4, axis=2).repeat(IMAGE_SIZE // 4, axis=3)
        return cls(
            (images[0], images[1]),
            rng.normal(size=(num_actions + 1, 6)),
            np.cumsum(rng.uniform(0.01, 0.02, (num_actions + 1, 7)), axis=0),
            np.stack([opening, -opening], axis=1),
            actions,
        )

    def write(self, group: Any, observed: slice) -> None:
        """Write a demonstration whose rows hold these moments' observations."""
        moments = np.arange(len(self.actions) + 1)[observed]
        group["actions"] = self.actions
        times = np.arange(len(self.actions) + 1)[:, None]
        drawn = np.concatenate([times, self.joints, self.fingers], axis=1)
        group["states"] = (drawn if self.simulator is None else self.simulator)[:-1]
        group["rewards"] = group["dones"] = (np.arange(len(self.actions)) == len(self.actions) - 1).astype(
            np.uint8
        )
        for name, images in zip(CAMERAS, self.images, strict=True):
            group[f"obs/{name}"] = images[moments]
        group["obs/ee_states"] = self.poses[moments]
        group["obs/ee_pos"], group["obs/ee_ori"] = self.poses[moments, :3], self.poses[moments, 3:]
        group["obs/gripper_states"], group["obs/joint_states"] = self.fingers[moments], self.joints[moments]


AFTER, BEFORE = slice(1, None), slice(None, -1)


def write_file(
    path: Path, demonstrations: list[Demonstration], observed: slice = AFTER, task: str = TASK, **attrs: str
) -> Path:
    """TASK_demo.hdf5 with the published attributes; observed before and without, as OpenVLA's copies are."""
    import h5py

    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        for number, episode in enumerate(demonstrations):
            episode.write(data.create_group(f"demo_{number}"), observed)
        if observed is AFTER:
            data.attrs["bddl_file_name"] = f"libero/libero/bddl_files/{SUITE}/{task}.bddl"
            data.attrs["macros_image_convention"] = "opengl"
            data.attrs["problem_info"] = '{"language_instruction": "Pick the akita black bowl on the stove"}'
        data.attrs.update(attrs)
    return path
