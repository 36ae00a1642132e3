"""Statistics of all frames: what is compared with them, and `lerobot-bomb doctor dataset`."""

import json
import logging
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from lerobot.configs import NormalizationMode
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies import make_policy
from policy_cases import CASES

from lerobot_bomb.commands.main import main
from lerobot_bomb.data.record import record
from lerobot_bomb.data.recording import Recording
from lerobot_bomb.data.statistics import exact_statistics, wrong_statistics

REPO_ID = "test/statistics"
STATS = Path("meta") / "stats.json"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("recorded") / "dataset"
    record(Recording(REPO_ID, episodes=3, image_size=64, images=True), root)
    return root


@pytest.fixture
def averaged(recorded: Path, tmp_path: Path) -> Path:
    """Copy the dataset with quantiles of the action as LeRobot has them: means over the episodes'."""
    root = shutil.copytree(recorded, tmp_path / "averaged")
    (path,) = (root / "meta" / "episodes").rglob("*.parquet")
    episodes = pq.read_table(path)
    change(
        root, **{q: np.mean(episodes[f"stats/action/{q}"].to_pylist(), 0).tolist() for q in ("q01", "q99")}
    )
    return root


def change(root: Path, **of_action: Any) -> None:
    statistics = json.loads((root / STATS).read_text())
    statistics["action"] |= of_action
    (root / STATS).write_text(json.dumps(statistics))


def test_statistics_of_numbers_that_one_can_count() -> None:
    found = exact_statistics(np.array([[0, 7], [1, 7], [2, 7], [3, 7], [4, 7]], dtype=np.float32))
    assert {name: values.tolist() for name, values in found.items()} == {
        "min": [0, 7],
        "max": [4, 7],
        "mean": [2, 7],
        "std": [2**0.5, 0],
        "count": [5],
        "q01": [pytest.approx(0.04), 7],
        "q10": [pytest.approx(0.4), 7],
        "q50": [2, 7],
        "q90": [pytest.approx(3.6), 7],
        "q99": [pytest.approx(3.96), 7],
    }


def test_a_recording_is_right_and_stays_as_it_is(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (recorded / STATS).read_bytes()
    assert main(["doctor", "dataset", str(recorded), "--mend"]) == 0
    assert capsys.readouterr().out == f"{recorded}: the statistics of its numbers are those of all frames\n"
    assert (recorded / STATS).read_bytes() == before


def test_a_conversion_is_right(pusht_dataset: Path) -> None:
    assert wrong_statistics(pusht_dataset) == []


def test_means_over_episodes_are_named_and_mended(
    averaged: Path, recorded: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["doctor", "dataset", str(averaged)]) == 3
    named, way_out = capsys.readouterr().out.splitlines()
    assert named.startswith("action: q01, q99 are missing or not those of all frames; ")
    assert way_out == f"`lerobot-bomb doctor dataset {averaged} --mend` writes those of all frames"
    assert main(["push", str(averaged), f"--repo_id={REPO_ID}", "--dry_run"]) == 1
    assert f"{averaged / STATS}: {named}; {way_out}\n" in capsys.readouterr().err
    assert main(["doctor", "dataset", str(averaged), "--mend"]) == 0
    assert (averaged / STATS).read_bytes() == (recorded / STATS).read_bytes()


@pytest.mark.parametrize("name", ["mean", "std", "min", "max", "count", "q50"])
def test_every_statistic_is_compared(name: str, averaged: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "dataset", str(averaged), "--mend"]) == 0
    value = json.loads((averaged / STATS).read_text())["action"][name]
    change(averaged, **{name: [value[0] + 1, *value[1:]]})
    capsys.readouterr()
    assert main(["doctor", "dataset", str(averaged)]) == 3
    assert capsys.readouterr().out.startswith(f"action: {name} are missing")


def test_a_dataset_of_which_frames_are_missing_is_not_judged(
    averaged: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    info = json.loads((averaged / "meta" / "info.json").read_text())
    info["total_frames"] += 1
    (averaged / "meta" / "info.json").write_text(json.dumps(info))
    assert main(["doctor", "dataset", str(averaged), "--mend"]) == 1
    num_frames = info["total_frames"]
    message = f"{averaged} holds {num_frames - 1} of the dataset's {num_frames} frames\n"
    assert capsys.readouterr().err == f"lerobot-bomb doctor dataset: {message}"


@pytest.mark.parametrize("mode", [NormalizationMode.QUANTILES, NormalizationMode.MIN_MAX])
def test_a_training_that_normalises_by_quantiles_says_that_they_are_wrong(
    mode: NormalizationMode, averaged: Path, caplog: pytest.LogCaptureFixture
) -> None:
    config = CASES["vla0_smol"].make_config()
    config.input_features = {}
    config.normalization_mapping |= {"ACTION": mode}
    with caplog.at_level(logging.WARNING):
        make_policy(config, ds_meta=LeRobotDatasetMetadata(REPO_ID, root=averaged))
    said = [each for each in caplog.messages if "action: q01, q99 are missing or not those" in each]
    assert len(said) == (mode is NormalizationMode.QUANTILES)
    assert all(f"`lerobot-bomb doctor dataset {averaged} --mend`" in each for each in said)
