"""A sample's chunk of actions is read without the images of its frames, and is what LeRobot reads."""

from pathlib import Path
from typing import Any, cast

import pytest
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.dataset_reader import DatasetReader
from PIL import PngImagePlugin
from pusht_cases import REPO_ID

from lerobot_bomb.compat.use import use

use()

CHUNK = {"action": [step / 10 for step in range(16)]}
TWO_IMAGES = {"observation.image": [-0.1, 0.0], "observation.state": [-0.1, 0.0]}


@pytest.mark.parametrize("deltas", [CHUNK, CHUNK | TWO_IMAGES], ids=["chunk", "chunk and two images"])
@pytest.mark.parametrize("episodes", [None, [1]], ids=["all episodes", "one episode"])
def test_it_is_what_lerobot_reads(
    pusht_dataset: Path,
    deltas: dict[str, list[float]],
    episodes: list[int] | None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def read() -> list[dict[str, Any]]:
        dataset = LeRobotDataset(
            REPO_ID, root=pusht_dataset, episodes=episodes, delta_timestamps=dict(deltas)
        )
        return [cast("Any", dataset[index]) for index in (0, 7, len(dataset) - 1)]

    ours = read()
    usual = cast("Any", DatasetReader._query_hf_dataset).__wrapped__
    monkeypatch.setattr(DatasetReader, "_query_hf_dataset", usual)
    for mine, theirs in zip(ours, read(), strict=True):
        assert mine.keys() == theirs.keys()
        for key, value in theirs.items():
            assert torch.equal(mine[key], value) if torch.is_tensor(value) else mine[key] == value


@pytest.mark.parametrize(("deltas", "images"), [(CHUNK, 1), (CHUNK | TWO_IMAGES, 3)])
def test_no_other_images_are_decoded(
    pusht_dataset: Path, deltas: dict[str, list[float]], images: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = []
    usual = PngImagePlugin.PngImageFile.load_prepare
    monkeypatch.setattr(
        PngImagePlugin.PngImageFile, "load_prepare", lambda self: opened.append(1) or usual(self)
    )
    dataset = LeRobotDataset(REPO_ID, root=pusht_dataset, delta_timestamps=dict(deltas))
    item = cast("Any", dataset[7])
    assert len(item["action"]) == 16
    assert len(opened) == images
