"""Frames in memory are the frames that LeRobot reads from the files."""

import pickle
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.dataset_reader import DatasetReader
from PIL import Image, ImageFile
from small_datasets import ACTION, write_dataset

from lerobot_bomb.compat.hooks import replace
from lerobot_bomb.compat.hooks.datasets import keep_frames_in_memory
from lerobot_bomb.data import kept_frames
from lerobot_bomb.data.kept_frames import KeptFrames, keep_frames

FPS, CHUNK = 10, 4
CAMERA = "observation.images.wrist"
TIMES = {ACTION: [step / FPS for step in range(CHUNK)], CAMERA: [-1 / FPS, 0.0]}


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a dataset of two episodes of six frames."""
    root = tmp_path_factory.mktemp("data") / "small"
    write_dataset(
        root,
        lambda frame: (np.array([frame, 0.1], np.float32), np.array([0.3 * frame], np.float32)),
        cameras=("wrist", "top"),
    )
    return root


@pytest.fixture
def in_memory() -> Iterator[None]:
    """Install the hook, and put back what was there."""
    name = "_load_hf_dataset"
    before = getattr(DatasetReader, name)
    keep_frames_in_memory(keep_frames)
    yield
    setattr(DatasetReader, name, before)


def read(root: Path, **options: Any) -> Any:
    """Read the dataset as `lerobot-train` does."""
    return LeRobotDataset("test/small", root=root, delta_timestamps=TIMES, **options)


@pytest.fixture
def stock(root: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return the dataset as LeRobot reads it without the plugin."""
    with monkeypatch.context() as patch:
        patch.setattr(DatasetReader, "_load_hf_dataset", original(DatasetReader._load_hf_dataset))
        return read(root)


def original(method: Any) -> Any:
    """Return what a method was before a hook took its place."""
    return getattr(method, replace.ORIGINAL, method)


def require_equal(item: dict[str, Any], expected: dict[str, Any]) -> None:
    assert list(item) == list(expected)
    for key, value in expected.items():
        if isinstance(value, torch.Tensor):
            assert item[key].dtype == value.dtype and torch.equal(item[key], value), key
        else:
            assert item[key] == value


@pytest.mark.usefixtures("in_memory")
@pytest.mark.parametrize("memory_share", [kept_frames.MEMORY_SHARE, 0])
def test_samples_equal_those_of_lerobot(
    root: Path, stock: Any, memory_share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kept_frames, "MEMORY_SHARE", memory_share)
    ours = read(root)
    assert isinstance(ours.hf_dataset, KeptFrames) and not isinstance(stock.hf_dataset, KeptFrames)
    for _ in range(2):  # decoded, then kept
        for index in range(len(stock)):
            require_equal(ours[index], stock[index])
    assert bool(ours.hf_dataset._kept) == bool(memory_share)


@pytest.mark.usefixtures("in_memory")
@pytest.mark.parametrize("episodes", [None, [1]])
def test_real_samples_equal_those_of_lerobot(
    pusht_dataset: Path, episodes: list[int] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    times = {ACTION: [step / FPS for step in range(16)], "observation.image": [-1 / FPS, 0.0]}

    def samples() -> list[Any]:
        dataset = LeRobotDataset("a/b", pusht_dataset, episodes=episodes, delta_timestamps=times)
        return [dataset[index] for index in (0, 7, len(dataset) - 1)]

    ours = samples()
    monkeypatch.setattr(DatasetReader, "_load_hf_dataset", original(DatasetReader._load_hf_dataset))
    for mine, theirs in zip(ours, samples(), strict=True):
        require_equal(mine, theirs)


@pytest.mark.usefixtures("in_memory")
def test_a_sample_may_be_changed_in_place(root: Path, stock: Any) -> None:
    ours = read(root)
    for value in ours[3].values():
        if isinstance(value, torch.Tensor):
            value.zero_()
    require_equal(ours[3], stock[3])


@pytest.mark.usefixtures("in_memory")
def test_each_image_is_decoded_once(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    loaded: list[Image.Image] = []
    usual = ImageFile.ImageFile.load

    def load(self: ImageFile.ImageFile) -> Any:
        if self.fp is not None:
            loaded.append(self)
        return usual(self)

    monkeypatch.setattr(ImageFile.ImageFile, "load", load)
    ours = read(root)
    for _ in range(2):
        assert len([ours[0], ours[1]]) == 2
    # both cameras of both frames; the chunk's other frames are read for their actions alone
    assert len(loaded) == 4


@pytest.mark.usefixtures("in_memory")
def test_some_episodes_and_worker_processes_read_the_same(root: Path, stock: Any) -> None:
    ours = read(root, episodes=[1])
    ours[0]
    copied = pickle.loads(pickle.dumps(ours.hf_dataset))
    assert not copied._kept and len(copied) == len(ours) == len(stock) // 2
    require_equal(ours[2], stock[len(stock) // 2 + 2])
    batches = list(torch.utils.data.DataLoader(ours, batch_size=3, num_workers=1))
    require_equal({key: value[0] for key, value in batches[1].items()}, ours[3])


@pytest.mark.usefixtures("in_memory")
def test_other_questions_are_answered_by_the_original(root: Path, stock: Any) -> None:
    ours = read(root)
    assert ours.hf_dataset.features == stock.hf_dataset.features
    assert torch.equal(torch.stack(list(ours.hf_dataset["index"][:])), torch.arange(len(stock)))
    assert len(ours.hf_dataset.select([0, 2])) == 2
    assert keep_frames(stock.hf_dataset.select_columns(ACTION)).column_names == [ACTION]
