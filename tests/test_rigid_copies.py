"""`lerobot-bomb convert pusht-zarr --copies`: what holds on the board holds for its rigid copies."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset
from pusht_cases import NUM_EPISODES, REPO_ID, Demonstrations, put

from lerobot_bomb.data.pusht_conversion import convert_pusht
from lerobot_bomb.data.pusht_zarr import BOARD_SIZE, IMAGE_SIZE
from lerobot_bomb.data.rigid_copies import MAX_SHIFT, RigidMotion

AGENT_RGB = (65, 105, 225)
COPIES = 2


def motions(number: int) -> list[RigidMotion]:
    return [RigidMotion.drawn(np.random.default_rng(seed), BOARD_SIZE) for seed in range(number)]


def agent_in(image: np.ndarray) -> np.ndarray:
    """Return where the image (96, 96, 3) shows the agent, in pixels of the board."""
    distances = np.abs(image.astype(int) - AGENT_RGB).sum(axis=2)
    rows, columns = np.nonzero(distances < 90)
    return (np.array([columns.mean(), rows.mean()]) + 0.5) * BOARD_SIZE / IMAGE_SIZE


def test_motions_keep_distances_and_half_of_them_mirror() -> None:
    points = np.random.default_rng(0).uniform(0, BOARD_SIZE, (20, 2))
    determinants = []
    for motion in motions(200):
        moved = motion.points(points)
        distances = np.linalg.norm(moved[:, None] - moved[None], axis=2)
        np.testing.assert_allclose(
            distances, np.linalg.norm(points[:, None] - points[None], axis=2), atol=1e-3
        )
        centre = motion.points(np.full((1, 2), BOARD_SIZE / 2))
        assert np.abs(centre - BOARD_SIZE / 2).max() <= MAX_SHIFT
        determinants.append(np.linalg.det(motion.linear))
    assert 70 < (np.array(determinants) < 0).sum() < 130


def test_images_move_as_positions_do(pusht_demonstrations: Demonstrations) -> None:
    steps = [40, 80]  # here nothing hides the agent
    positions = pusht_demonstrations.states[steps, :2].astype(np.float32)
    images = pusht_demonstrations.images[steps].astype(np.uint8)
    for image, position in zip(images, positions, strict=True):
        np.testing.assert_allclose(agent_in(image), position, atol=3)
    for motion in motions(10):
        moved = motion.images(images)
        for image, position in zip(moved, motion.points(positions), strict=True):
            np.testing.assert_allclose(agent_in(image), position, atol=3)


def test_the_simulator_agrees(pusht_demonstrations: Demonstrations) -> None:
    """Moved actions lead a moved agent and a moved block where the demonstration went, moved."""
    simulator = pytest.importorskip("gym_pusht.envs.pusht")
    states, actions = pusht_demonstrations.states, pusht_demonstrations.actions
    for motion in motions(6):
        # the T is its own mirror image about its y axis
        angles = states[:, 4]
        axis = motion.linear @ np.stack([-np.sin(angles), np.cos(angles)])
        turned = np.arctan2(-axis[0], axis[1])
        is_mirrored = np.linalg.det(motion.linear) < 0
        assert is_mirrored or np.isclose(np.cos(turned[0] - angles[0]), motion.linear[0, 0])
        start = np.concatenate(
            [motion.points(states[:1, :2])[0], motion.points(states[:1, 2:4])[0], turned[:1]]
        )
        pusht: Any = simulator.PushTEnv()
        pusht.reset(seed=0)
        put(pusht, start)
        for step in range(pusht_demonstrations.ends[0] - 1):
            pusht.step(motion.points(actions[step : step + 1])[0])
            expected = motion.points(states[step + 1, [[0, 1], [2, 3]]])
            np.testing.assert_allclose(pusht.agent.position, expected[0], atol=1)
            np.testing.assert_allclose(pusht.block.position, expected[1], atol=1)


def test_copies_follow_the_demonstrations(pusht_demonstrations: Demonstrations, tmp_path: Path) -> None:
    source, root = tmp_path / "source.zarr", tmp_path / "copies"
    pusht_demonstrations.write(source)
    progress = convert_pusht(source, REPO_ID, root, copies=COPIES)
    assert progress.num_episodes == NUM_EPISODES * (1 + COPIES)
    dataset = LeRobotDataset(REPO_ID, root=root, video_backend="pyav")
    rows: Any = dataset.hf_dataset.with_format(None)
    recorded = np.array(rows["action"][:], np.float32)
    actions = pusht_demonstrations.actions
    np.testing.assert_array_equal(recorded[: len(actions)], actions)
    assert len(recorded) == (1 + COPIES) * len(actions)
    for copy in range(1, COPIES + 1):
        copied = recorded[copy * len(actions) :][: pusht_demonstrations.ends[0]]
        original = actions[: pusht_demonstrations.ends[0]]
        assert np.abs(copied - original).max() > 10
        np.testing.assert_allclose(
            np.linalg.norm(np.diff(copied, axis=0), axis=1),
            np.linalg.norm(np.diff(original, axis=0), axis=1),
            atol=1e-3,
        )
    with pytest.raises(ValueError, match="--copies=-1 must not be negative"):
        convert_pusht(source, REPO_ID, tmp_path / "none", copies=-1)
