"""`lerobot-dataset-viz` on recordings. Workers import this file's head, so LeRobot is imported inside."""

import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lerobot_bomb.data.record import record
from lerobot_bomb.data.recording import Recording

SIZE = 64
# component of Rerun that holds an entity's values
VALUES = {
    "/observation.images.workspace": "Image:buffer",
    "/observation.images.wrist": "Image:buffer",
    "/state": "Scalars:scalars",
    "/action": "Scalars:scalars",
}


def logged(path: Path) -> dict[str, np.ndarray]:
    """Values of every entity in a file of Rerun, one row per frame."""
    from rerun.experimental import RrdReader

    frames: dict[str, dict[int, np.ndarray]] = defaultdict(dict)
    for chunk in RrdReader(path).stream():
        if chunk.entity_path.startswith("/__"):
            continue  # properties of the recording
        columns = chunk.to_record_batch().to_pydict()
        values = columns[VALUES[chunk.entity_path]]
        for index, value in zip(columns["frame_index"], values, strict=True):
            # one list more around an image's bytes
            frames[chunk.entity_path][index] = np.ravel(value)
    return {entity: np.array([rows[i] for i in range(len(rows))]) for entity, rows in frames.items()}


@pytest.mark.parametrize("images", [False, True], ids=["video", "images"])
def test_the_stock_viewer_shows_a_recording(
    images: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import rerun
    from lerobot.datasets import LeRobotDataset
    from lerobot.scripts import lerobot_dataset_viz

    root = tmp_path / "dataset"
    record(Recording("test/viz", episodes=2, image_size=SIZE, images=images), root)
    flags = ["--repo-id=test/viz", f"--root={root}", "--episode-index=1", "--num-workers=0"]
    monkeypatch.setattr(sys, "argv", ["lerobot-dataset-viz", *flags, "--save=1", f"--output-dir={tmp_path}"])
    lerobot_dataset_viz.main()
    rerun.disconnect()  # the command's process would end here, and with it the file
    shown = logged(tmp_path / "test_viz_episode_1.rrd")

    dataset: Any = LeRobotDataset("test/viz", root=root, episodes=[1])
    frames = [dataset[index] for index in range(len(dataset))]
    assert shown.keys() == VALUES.keys()
    for entity, key in {"/state": "observation.state", "/action": "action"}.items():
        np.testing.assert_array_equal(shown[entity], np.stack([frame[key] for frame in frames]))
    for entity in ("/observation.images.workspace", "/observation.images.wrist"):
        expected = np.stack([frame[entity[1:]].permute(1, 2, 0) for frame in frames]) * 255
        assert np.ptp(expected) > 50  # not one colour
        # the command cuts fractions off
        np.testing.assert_allclose(shown[entity].reshape(expected.shape), expected, atol=1.01)
