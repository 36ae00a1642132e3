"""`lerobot-bomb record`. Simulator workers import this file's head, so LeRobot is imported inside tests."""

import errno
import gc
import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lerobot_bomb import __version__
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.expert import expert_action
from lerobot_bomb.bomb.observation import CAMERAS, RenderOptions
from lerobot_bomb.bomb.perturbations import NUISANCES
from lerobot_bomb.bomb.privileged_state import PrivilegedState
from lerobot_bomb.commands.main import main
from lerobot_bomb.data import recorded_blocks, resumable
from lerobot_bomb.data.facts import DatasetFacts
from lerobot_bomb.data.kept_blocks import Progress, read_progress
from lerobot_bomb.data.record import record
from lerobot_bomb.data.recorded_blocks import describe_failures
from lerobot_bomb.data.recording import Recording
from lerobot_bomb.data.rollout_pool import RolloutSettings, collect
from lerobot_bomb.data.unfinished import METADATA_FILE, unfinished_folder
from lerobot_bomb.envs.rollout import make_env

SIZE = 64
SMALL = RenderOptions(image_size=SIZE)
TASK_VERSION = "1.0"  # of `place`
VIDEO = Recording("test/video", episodes=5, seed=3, image_size=SIZE)
IMAGES = Recording("test/images", episodes=2, image_size=SIZE, control_mode="absolute", images=True)
FEATURES = {"observation.images.workspace", "observation.images.wrist", "observation.state", "action"}


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write blocks of 2 episodes, so that a short recording is merged from several."""
    monkeypatch.setattr(resumable, "BLOCK_EPISODES", 2)


@pytest.fixture(scope="module")
def datasets(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Make two uninterrupted recordings."""
    roots = {name: tmp_path_factory.mktemp("recorded") / name for name in ("video", "images")}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(resumable, "BLOCK_EPISODES", 2)
        record(VIDEO, roots["video"])
        record(IMAGES, roots["images"])
    return roots


def contents(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def episode_rows(root: Path) -> list[Any]:
    """LeRobot's table of episodes."""
    from lerobot.datasets import LeRobotDatasetMetadata

    return list(LeRobotDatasetMetadata("test/any", root=root).episodes or [])


def stand_still(state: PrivilegedState) -> np.ndarray:
    return np.array([0, 0, 0, 1], dtype=np.float32)


def misplace_white(state: PrivilegedState) -> np.ndarray:
    """Put white stones down 2 cm from their places: that fails, and sooner than standing still."""
    off = [np.array([0.02 * is_white, 0, 0]) for is_white in state.stone_is_white]
    goals = [replace(each, xyz=each.xyz + off[each.stone]) for each in state.goals]
    return expert_action(replace(state, goals=tuple(goals)))


@pytest.mark.parametrize("recording", [VIDEO, IMAGES], ids=["video", "images"])
def test_a_dataset_reads_back_through_lerobot(recording: Recording, datasets: dict[str, Path]) -> None:
    from lerobot.datasets import LeRobotDataset
    from lerobot.utils.constants import DEFAULT_FEATURES

    root = datasets["images" if recording.images else "video"]
    dataset = LeRobotDataset(recording.repo_id, root=root, video_backend="pyav")
    assert set(dataset.features) == FEATURES | set(DEFAULT_FEATURES)
    for camera in CAMERAS:
        feature = dataset.features[f"observation.images.{camera}"]
        assert feature["dtype"] == ("image" if recording.images else "video")
        assert feature["shape"] == (SIZE, SIZE, 3)
        assert feature["names"] == ["height", "width", "channels"]
    assert dataset.features["observation.state"]["names"] == ["x", "y", "z", "finger_opening"]
    first = "x" if recording.control_mode == "absolute" else "dx"
    assert dataset.features["action"]["names"][0] == first
    assert (dataset.fps, dataset.meta.robot_type) == (10, "bomb_scara_v1.1")  # of all suites
    assert dataset.num_episodes == recording.episodes
    progress = read_progress(root / METADATA_FILE)
    assert len(dataset) == progress.num_frames
    for index in (0, len(dataset) - 1):
        item: Any = dataset[index]
        assert item["observation.images.wrist"].shape == (3, SIZE, SIZE)
        assert item["observation.state"].dtype == item["action"].dtype
        assert item["action"].shape == item["observation.state"].shape == (4,)
        assert "stone" in item["task"]


def test_policies_see_cameras_state_and_action_only(datasets: dict[str, Path]) -> None:
    from lerobot.datasets import LeRobotDatasetMetadata
    from lerobot.utils.feature_utils import dataset_to_policy_features

    metadata = LeRobotDatasetMetadata(VIDEO.repo_id, root=datasets["video"])
    assert set(dataset_to_policy_features(metadata.features)) == FEATURES


@pytest.mark.parametrize("recording", [VIDEO, IMAGES], ids=["video", "images"])
def test_recorded_actions_replay_to_the_same_success(recording: Recording, datasets: dict[str, Path]) -> None:
    from lerobot.datasets import LeRobotDataset

    root = datasets["images" if recording.images else "video"]
    dataset = LeRobotDataset(recording.repo_id, root=root, video_backend="pyav")
    for episode in episode_rows(root):
        spec = EpisodeSpec(**json.loads(episode["bomb/spec"]))
        env = make_env(spec, SMALL)
        observation, info = env.reset(seed=spec.seed)
        for index in range(episode["dataset_from_index"], episode["dataset_to_index"]):
            assert not info["is_success"]
            item: Any = dataset[index]
            assert item["observation.state"].numpy() == pytest.approx(observation["agent_pos"], abs=0)
            assert item["task"] == env.get_wrapper_attr("task_description")
            shown = (item["observation.images.workspace"].numpy().transpose(1, 2, 0) * 255).round()
            difference = np.abs(shown - observation["pixels"]["workspace"]).mean()
            assert difference == 0 if recording.images else difference < 8
            observation, _, _, _, info = env.step(item["action"].numpy())
        assert info["is_success"]
        env.close()


def test_episodes_carry_what_determines_them(datasets: dict[str, Path]) -> None:
    rows = episode_rows(datasets["video"])
    assert [row["bomb/seed"] for row in rows] == [3, 4, 5, 6, 7]
    assert {row["bomb/protocol_version"] for row in rows} == {TASK_VERSION}
    assert {row["bomb/package_version"] for row in rows} == {__version__}
    assert json.loads(rows[0]["bomb/spec"]) == EpisodeSpec(seed=3).to_dict()
    (instruction,) = rows[0]["tasks"]
    row, column = rows[0]["bomb/target"]
    assert str(row) in instruction
    assert str(column) in instruction
    assert rows[0]["bomb/color"] in instruction
    written = json.loads((datasets["video"] / METADATA_FILE).read_text())["recording"]
    versions = {"protocol_version": TASK_VERSION, "package_version": __version__}
    assert written == {**VIDEO.to_dict(), **versions}


def test_episode_columns_survive_a_merge_with_another_dataset(
    datasets: dict[str, Path], tmp_path: Path
) -> None:
    from lerobot.datasets import aggregate_datasets

    roots = [datasets["images"]] * 2
    aggregate_datasets(["test/images"] * 2, "test/merged", roots=roots, aggr_root=tmp_path / "merged")
    assert [row["bomb/seed"] for row in episode_rows(tmp_path / "merged")] == [0, 1, 0, 1]


@pytest.mark.parametrize("name", ["video", "images"])
def test_statistics_of_numbers_are_those_of_all_frames(name: str, datasets: dict[str, Path]) -> None:
    statistics = json.loads((datasets[name] / "meta" / "stats.json").read_text())
    table = pa.concat_tables(map(pq.read_table, sorted((datasets[name] / "data").rglob("*.parquet"))))
    for key in ("action", "observation.state"):
        frames = np.array(table[key].to_pylist())
        found = {each: np.array(values) for each, values in statistics[key].items()}
        quantiles = {q: np.quantile(frames, int(q[1:]) / 100, axis=0) for q in found if q[1:].isdigit()}
        assert sorted(quantiles) == ["q01", "q10", "q50", "q90", "q99"]
        bounds = {"min": frames.min(axis=0), "max": frames.max(axis=0)}
        expected = quantiles | bounds | {"mean": frames.mean(axis=0), "std": frames.std(axis=0)}
        assert found.pop("count") == [len(frames)]
        assert found.keys() == expected.keys()
        for each, values in expected.items():
            np.testing.assert_allclose(found[each], values, rtol=0, atol=1e-6, err_msg=f"{key} {each}")


def test_image_statistics_are_those_of_all_pixels(tmp_path: Path) -> None:
    recording = Recording("test/full", episodes=1)
    record(recording, tmp_path / "full")
    statistics = json.loads((tmp_path / "full" / "meta" / "stats.json").read_text())
    spec = next(recording.specs(0))
    env = make_env(spec, recording.render_options)
    rollout = collect(env, spec, RolloutSettings(recording.render_options))
    env.close()
    for camera, frames in rollout.frames.items():
        found = statistics[f"observation.images.{camera}"]
        assert found["count"] == [rollout.result.steps * 256 * 256]
        assert np.ravel(found["mean"]) == pytest.approx(frames.mean(axis=(0, 1, 2)) / 255, abs=1e-6)
        assert np.ravel(found["std"]) == pytest.approx(frames.std(axis=(0, 1, 2)) / 255, abs=1e-6)


def test_the_number_of_workers_does_not_change_a_byte(datasets: dict[str, Path], tmp_path: Path) -> None:
    record(VIDEO, tmp_path / "video", num_workers=2)
    assert contents(tmp_path / "video") == contents(datasets["video"])


def test_failed_episodes_are_left_out_and_counted(tmp_path: Path) -> None:
    recording = Recording("test/half", episodes=3, image_size=SIZE)
    progress = record(recording, tmp_path / "half", expert=misplace_white)
    rows = episode_rows(tmp_path / "half")
    kept = [row["bomb/seed"] for row in rows]
    failed = [failure["seed"] for failure in progress.failures]
    assert {row["bomb/color"] for row in rows} == {"black"}
    assert failed
    assert sorted(kept + failed) == list(range(progress.num_tried))
    assert read_progress(tmp_path / "half" / METADATA_FILE) == progress


def test_every_seed_is_run_with_every_task(tmp_path: Path) -> None:
    recording = Recording("test/tasks", episodes=3, seed=6, image_size=SIZE, task_ids=(7, 34), images=True)
    assert [spec.seed for spec, _ in zip(recording.specs(num_tried=3), range(3), strict=False)] == [7, 8, 8]
    record(recording, tmp_path / "tasks")
    rows = episode_rows(tmp_path / "tasks")
    assert [row["bomb/seed"] for row in rows] == [6, 6, 7]
    assert [(row["bomb/target"], row["bomb/color"]) for row in rows] == [
        ([1, 2], "black"),
        ([1, 4], "white"),
        ([1, 2], "black"),
    ]
    spec = json.loads(rows[1]["bomb/spec"])
    assert (spec["seed"], spec["target"], spec["color"]) == (6, [1, 4], "white")
    assert record(recording, tmp_path / "tasks", resume=True).num_episodes == 3


def test_a_given_target_and_colour_are_run_from_every_seed(tmp_path: Path) -> None:
    root = tmp_path / "x"
    flags = f"--repo_id=test/x --root={root} --episodes=2 --seed=3 --image_size=32 --images"
    of_all = ["--target=[1,2]", "--color=white", "--success_tolerance_mm=9.5"]
    assert main(["record", *flags.split(), *of_all]) == 0
    rows = episode_rows(root)
    spec = EpisodeSpec(3, target=(1, 2), color="white", success_tolerance_mm=9.5)
    assert [json.loads(row["bomb/spec"]) for row in rows] == [
        {**spec.to_dict(), "target": [1, 2], "seed": seed} for seed in (3, 4)
    ]
    assert [(row["bomb/target"], row["bomb/color"]) for row in rows] == 2 * [([1, 2], "white")]
    assert all("white" in row["tasks"][0] for row in rows)
    facts = DatasetFacts.read(root)
    assert (facts.recording["target"], facts.recording["color"]) == ([1, 2], "white")
    assert any("tasks: target [1, 2], color white" in line for line in facts.lines())
    assert "--env.task_ids=[32]" in (facts.eval_flags() or ())


def test_every_seed_is_run_under_every_condition_at_the_levels_it_draws(tmp_path: Path) -> None:
    conditions = ("none", "all:1-5")
    recording = Recording(
        "test/perturbed", episodes=4, seed=2, image_size=SIZE, perturbations=conditions, images=True
    )
    record(recording, tmp_path / "perturbed")
    rows = episode_rows(tmp_path / "perturbed")
    specs = [json.loads(row["bomb/spec"]) for row in rows]
    assert [(spec["seed"], spec["perturbations"]) for spec in specs] == [
        (seed, condition) for seed in (2, 3) for condition in conditions
    ]
    levels = [json.loads(row["bomb/levels"]) for row in rows]
    assert levels[0] == levels[2] == {}
    assert levels[1] != levels[3] and set(levels[1]) == set(NUISANCES)
    assert rows[0]["bomb/target"] == rows[1]["bomb/target"]  # a pair


def test_lerobot_merges_suites_but_no_older_tasks(datasets: dict[str, Path], tmp_path: Path) -> None:
    from lerobot.datasets import aggregate_datasets

    def merge(other: Path, merged: Path) -> None:
        aggregate_datasets(
            ["test/a", "test/b"], "test/merged", roots=[datasets["images"], other], aggr_root=merged
        )

    record(replace(IMAGES, task="object", episodes=1), tmp_path / "object")
    merge(tmp_path / "object", tmp_path / "merged")
    environment = DatasetFacts.read(tmp_path / "merged").environment
    assert environment is not None and environment.suites == {"place", "object"}
    assert environment.task_version == "1.1"
    info = tmp_path / "object" / "meta" / "info.json"
    info.write_text(info.read_text().replace("_v1.1", "_v1.0"))
    with pytest.raises(ValueError, match="bomb_scara_v1"):
        merge(tmp_path / "object", tmp_path / "refused")


def test_a_recording_of_another_protocol_version_is_not_resumed(
    datasets: dict[str, Path], tmp_path: Path
) -> None:
    old = replace(IMAGES, protocol_version="0.0")
    with pytest.raises(ValueError, match=rf"differs in protocol_version='0.0' \(it has {TASK_VERSION!r}\)"):
        record(old, datasets["images"], resume=True)


def test_a_recording_names_its_simulator_and_goes_on_under_no_other(datasets: dict[str, Path]) -> None:
    recorded = json.loads((datasets["images"] / METADATA_FILE).read_text())["recording"]
    assert recorded["mujoco_version"] == version("mujoco")
    other = replace(IMAGES, mujoco_version="3.8.0")
    with pytest.raises(ValueError, match=rf"mujoco_version='3\.8\.0' \(it has '{version('mujoco')}'\)"):
        record(other, datasets["images"], resume=True)


def test_failures_are_described_by_class_and_seed() -> None:
    failures = [{"seed": s, "failure": f} for s, f in ((2, "imprecise"), (5, "dropped"), (9, "imprecise"))]
    expected = "3 failed and were left out: 1 dropped (seeds 5); 2 imprecise (seeds 2, 9)"
    assert describe_failures(failures) == expected
    assert describe_failures([]) == "No episode was left out."


def test_a_broken_expert_ends_the_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorded_blocks, "MIN_TRIED", 2)
    with pytest.raises(RuntimeError, match=r"only 0 of 2 episodes succeeded.*never_reached.*0, 1"):
        record(Recording("test/x", episodes=1, image_size=SIZE), tmp_path / "x", expert=stand_still)
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_recording_resumes_to_the_same_bytes(
    datasets: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from lerobot_bomb.data import blocks

    write = blocks._write_episode
    episodes = iter(range(10))

    def write_three(dataset, rollout) -> None:
        if next(episodes) == 3:
            raise KeyboardInterrupt
        write(dataset, rollout)

    root = tmp_path / "video"
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(blocks, "_write_episode", write_three)
        record(VIDEO, root)
    assert list(tmp_path.iterdir()) == [unfinished_folder(root)]
    progress = record(VIDEO, root, resume=True)
    assert progress.num_episodes == 5
    assert contents(root) == contents(datasets["video"])
    assert list(tmp_path.iterdir()) == [root]


def test_a_recording_stopped_while_a_video_is_joined_closes_it_quietly(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import av

    class Stopped:
        """A container that is read to its second packet."""

        def __init__(self, container: Any) -> None:
            self.container = container
            self.streams = container.streams

        def demux(self) -> Iterator[Any]:
            yield next(self.container.demux())
            raise KeyboardInterrupt

    def open_container(*args: Any, **options: Any) -> Any:
        container = opened(*args, **options)
        return Stopped(container) if options.get("format") == "concat" else container

    opened = av.open
    ignored: list[Any] = []
    with monkeypatch.context() as patch:
        patch.setattr(sys, "unraisablehook", ignored.append)
        patch.setattr(av, "open", open_container)
        with pytest.raises(KeyboardInterrupt):
            record(VIDEO, tmp_path / "video")
        gc.collect()
    assert [str(unraisable.exc_value) for unraisable in ignored] == []
    assert list(tmp_path.iterdir()) == []


def test_an_image_that_is_not_written_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from PIL.Image import Image

    save = Image.save

    def save_half(image: Image, path: Path, **options: Any) -> None:
        save(image, path, **options)
        if path.name == "frame-000003.png":
            path.write_bytes(path.read_bytes()[:-100])
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Image, "save", save_half)
    with pytest.raises(RuntimeError, match=r"Error writing image .*frame-000003.png: .*No space left"):
        record(IMAGES, tmp_path / "images")
    assert list(tmp_path.iterdir()) == []


def test_images_put_into_tables_in_batches_are_the_same(
    datasets: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from contextlib import nullcontext

    from lerobot_bomb.data import blocks

    monkeypatch.setattr(blocks, "batched_embedding", nullcontext)  # LeRobot's own way, row by row
    record(IMAGES, tmp_path / "images")
    files = sorted(path.relative_to(tmp_path) for path in tmp_path.rglob("data/**/*.parquet"))
    assert files
    for file in files:
        assert pq.read_table(tmp_path / file).equals(pq.read_table(datasets["images"].parent / file))


def test_resuming_a_complete_recording_changes_nothing(datasets: dict[str, Path]) -> None:
    before = contents(datasets["video"])
    num_frames = json.loads(before["meta/info.json"])["total_frames"]
    assert record(VIDEO, datasets["video"], resume=True) == Progress(5, num_frames, [])
    assert contents(datasets["video"]) == before
