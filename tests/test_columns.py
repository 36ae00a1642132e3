import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata

from lerobot_bomb.data.columns import DONE, EPISODE_INDEX, dim_names, episode_bounds, read_columns, run_index
from lerobot_bomb.data.record import record
from lerobot_bomb.data.recording import Recording

KEYS = ("observation.state", "action")


@pytest.fixture(scope="module", params=["video", "images"])
def dataset(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> LeRobotDataset:
    root = tmp_path_factory.mktemp("columns") / request.param
    images = request.param == "images"
    record(Recording("test/columns", episodes=3, image_size=32, images=images, depth=images), root)
    return LeRobotDataset("test/columns", root=root)


def test_columns_are_what_lerobot_reads(dataset: LeRobotDataset) -> None:
    numeric = dataset.features.keys() - set(dataset.meta.camera_keys)  # of images also depth, (H, W)
    columns = read_columns(dataset.meta, numeric)
    assert set(columns) == numeric
    for key, values in columns.items():
        expected = np.stack([np.asarray(value) for value in dataset.hf_dataset[key]])
        assert values.dtype == dataset.features[key]["dtype"]
        np.testing.assert_array_equal(values, expected, err_msg=key)


def test_columns_of_some_episodes_come_in_the_datasets_order(dataset: LeRobotDataset) -> None:
    everything = read_columns(dataset.meta, KEYS)
    some = read_columns(dataset.meta, KEYS, episodes=[2, 0, 2])
    kept = np.isin(everything["episode_index"], [0, 2])
    assert 0 < kept.sum() < len(kept)
    for key in (*KEYS, "episode_index"):
        np.testing.assert_array_equal(some[key], everything[key][kept], err_msg=key)


def test_episodes_that_do_not_exist_are_named(dataset: LeRobotDataset) -> None:
    with pytest.raises(ValueError, match=r"has the episodes 0\.\.2; asked for \[3\]"):
        read_columns(dataset.meta, KEYS, episodes=[1, 3])
    with pytest.raises(ValueError, match="none at all"):
        read_columns(dataset.meta, KEYS, episodes=[])


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_frames_that_are_not_finite_are_counted_and_named(
    dataset: LeRobotDataset, tmp_path: Path, bad: float
) -> None:
    """Check that frames are named by their place in the dataset, whichever episodes are read."""
    copied = tmp_path / "copied"
    shutil.copytree(dataset.root, copied)
    (file,) = (copied / "data").rglob("*.parquet")
    table = pq.read_table(file)
    column = table.schema.get_field_index("action")
    rows = table["action"].to_pylist()
    starts = [table["episode_index"].to_pylist().index(episode) for episode in range(3)]
    for frame in (starts[2] + 1, starts[2] + 3):
        rows[frame][1] = bad
    values = pa.chunked_array([pa.array(rows, type=table.schema.field("action").type)])
    pq.write_table(table.set_column(column, table.schema.field("action"), values), file)
    meta = LeRobotDatasetMetadata("test/columns", root=copied)
    read_columns(meta, KEYS, episodes=[0, 1])
    message = rf"'action' .* in 2 of {len(rows) - starts[2]} frames, the first of them frame {starts[2] + 1} "
    with pytest.raises(ValueError, match=rf"{message}.* of episode 2: .*episode_indices=\[2\]"):
        read_columns(meta, KEYS, episodes=[2])


@pytest.mark.parametrize("key", ["observation.images.wrist", "observation.velocity"])
def test_images_and_unknown_keys_are_refused(dataset: LeRobotDataset, key: str) -> None:
    with pytest.raises(ValueError, match=rf"no columns \['{key}'\]; it has \['action', 'episode_index'"):
        read_columns(dataset.meta, ["action", key])


def test_an_absent_data_file_is_named(dataset: LeRobotDataset, tmp_path: Path) -> None:
    (tmp_path / "meta").symlink_to(dataset.root / "meta")
    with pytest.raises(FileNotFoundError, match=r"file-000\.parquet"):
        read_columns(LeRobotDatasetMetadata("test/columns", root=tmp_path), KEYS)


def test_runs_are_episodes_or_static_scenes() -> None:
    episodes = {EPISODE_INDEX: np.array([3, 3, 3, 5, 5])}
    assert run_index(episodes).tolist() == [0, 0, 0, 1, 1]
    done = np.array([[False], [False], [True], [True], [True]])  # episode 5 holds scenes
    assert run_index(episodes | {DONE: done}).tolist() == [0, 0, 0, 1, 2]


def test_episode_bounds() -> None:
    starts, ends = episode_bounds(np.array([3, 3, 3, 5, 8, 8]))
    assert starts.tolist() == [0, 0, 0, 3, 4, 4]
    assert ends.tolist() == [3, 3, 3, 4, 6, 6]


def test_names_of_dimensions() -> None:
    assert dim_names({"shape": (2,), "names": ["a", "b"]}) == ["a", "b"]
    assert dim_names({"shape": [2], "names": {"motors": ["a", "b"]}}) == ["a", "b"]
    assert dim_names({"shape": (2,), "names": None}) == ["0", "1"]
