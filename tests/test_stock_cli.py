"""LeRobot's own commands on our types, in one process: what a user types must run end to end."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from huggingface_hub.utils import validate_repo_id

from lerobot_bomb.commands.main import main
from lerobot_bomb.results.bomb import EpisodeResult
from lerobot_bomb.results.groups import read_results
from lerobot_bomb.results.origin import Evaluation

Run = Callable[..., None]
REPO_ID = "test/bomb_place"
SHORT = "--env.fps=1 --env.ignore_checkpoint=true"  # episodes of 10 steps, on recordings at 10 Hz


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("recorded") / "dataset"
    flags = [f"--repo_id={REPO_ID}", f"--root={root}", "--episodes=2", "--image_size=64", "--images"]
    assert main(["record", *flags]) == 0
    return root


def evaluate(run: Run, folder: Path, flags: str) -> dict:
    """eval_info.json of lerobot-eval; episode results go to folder/results.jsonl."""
    own = (
        f"--env.type=bomb --env.task=place --env.image_size=64 --env.results_path={folder / 'results.jsonl'}"
    )
    run(
        "lerobot-eval", *own.split(), "--policy.device=cpu", f"--output_dir={folder / 'eval'}", *flags.split()
    )
    return json.loads((folder / "eval" / "eval_info.json").read_text())


def train(run: Run, dataset: Path, output_dir: Path, flags: str) -> Path:
    """The checkpoint folder that lerobot-train leaves."""
    own = "--policy.device=cpu --batch_size=2 --num_workers=0 --wandb.enable=false --save_freq=1"
    data = [f"--dataset.repo_id={REPO_ID}", f"--dataset.root={dataset}", f"--output_dir={output_dir}"]
    run("lerobot-train", *data, *own.split(), *flags.split())
    return output_dir / "checkpoints" / "last" / "pretrained_model"


def test_the_expert_places_stones_through_lerobot_eval(
    stock_cli: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = "--policy.type=bomb_expert --eval.n_episodes=4 --eval.batch_size=2 --eval.use_async_envs=true"
    info = evaluate(stock_cli, tmp_path, f"{flags} --seed=5")
    assert info["per_group"]["place"]["pc_success"] == 100.0
    assert capsys.readouterr().err.count(f"next: lerobot-bomb results {tmp_path / 'results.jsonl'}\n") == 1
    rows = read_results(tmp_path / "results.jsonl", EpisodeResult)
    assert sorted(row.spec.seed for row in rows) == [5, 6, 7, 8]
    assert all(row.is_success and row.placement_error_mm < 10 for row in rows)
    videos = info["overall"]["video_paths"]
    assert len(videos) == 4
    assert all(Path(video).stat().st_size > 1000 for video in videos)


def test_numbered_tasks_and_absolute_control(stock_cli: Run, tmp_path: Path) -> None:
    flags = "--env.control_mode=absolute --env.task_ids=[0,38] --env.fps=5"
    flags += " --policy.type=bomb_expert --eval.n_episodes=1 --eval.batch_size=1"
    info = evaluate(stock_cli, tmp_path, flags)
    assert [task["task_id"] for task in info["per_task"]] == [0, 38]
    assert info["overall"]["pc_success"] == 100.0


def test_each_condition_has_a_rate_and_a_recording(stock_cli: Run, tmp_path: Path) -> None:
    flags = '--env.perturbations=["none","camera:3","all:5"] --policy.type=bomb_expert --eval.recording=true'
    flags += " --eval.n_episodes=1 --env.fps=5"
    info = evaluate(stock_cli, tmp_path, flags)
    keys = ["place.none", "place.camera-3", "place.all-5"]
    assert {key: info["per_group"][key]["pc_success"] for key in keys} == dict.fromkeys(keys, 100.0)
    rows = read_results(tmp_path / "results.jsonl", EpisodeResult)
    instructions = {row.spec.perturbations: row.instruction for row in rows}
    assert sorted(row.spec.perturbations for row in rows) == ["all:5", "camera:3", "none"]
    recordings = tmp_path / "eval" / "recordings"
    assert {path.name for path in recordings.iterdir()} == {f"{key}_0" for key in keys}
    for key, condition in zip(keys, ("none", "camera:3", "all:5"), strict=True):
        validate_repo_id(f"me/recorded_{key}_0")  # what --eval.recording_repo_id makes of it
        tasks = pq.read_table(recordings / f"{key}_0" / "meta" / "tasks.parquet")
        assert tasks["task"].to_pylist() == [instructions[condition]]
    # the nominal condition has the same seeds, targets and colours
    episodes = {
        condition: [(r.spec.seed, r.target, r.color) for r in rows if r.spec.perturbations == condition]
        for condition in ("none", "camera:3", "all:5")
    }
    assert episodes["none"] == episodes["camera:3"] == episodes["all:5"]


def test_surplus_episodes_of_the_last_batch_are_in_no_file(stock_cli: Run, tmp_path: Path) -> None:
    flags = "--policy.type=bomb_random --eval.n_episodes=4 --eval.batch_size=3 --eval.use_async_envs=false"
    info = evaluate(
        stock_cli, tmp_path, f'{flags} --seed=5 --env.fps=1 --env.perturbations=["none","light:3"]'
    )
    assert info["overall"]["n_episodes"] == 8
    rows = read_results(tmp_path / "results.jsonl", EpisodeResult)
    assert [(each.spec.perturbations, each.spec.seed) for each in rows] == [
        (condition, seed) for condition in ("none", "light:3") for seed in (5, 6, 7, 8)
    ]
    assert {each.evaluation for each in rows} == {Evaluation(num_episodes=8, seed=5)}


def test_a_video_ends_with_the_outcome(
    stock_cli: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from lerobot.scripts import lerobot_eval

    from lerobot_env_bomb.bomb import env
    from lerobot_env_bomb.bomb.render import compose_caption

    drawn, filmed = [], []

    def noting(images: list[np.ndarray], lines: list[str]) -> np.ndarray:
        drawn.append((compose_caption(images, lines), lines[-1]))
        return drawn[-1][0]

    monkeypatch.setattr(env, "compose_caption", noting)
    monkeypatch.setattr(lerobot_eval, "write_video", lambda path, frames, fps: filmed.append(frames))
    flags = "--policy.type=bomb_random --eval.n_episodes=2 --eval.batch_size=1"
    evaluate(stock_cli, tmp_path, f"{flags} --env.fps=2")
    assert [len(frames) for frames in filmed] == [20, 20]
    for (image, caption), frames in zip(drawn[19::20], filmed, strict=True):
        assert caption.endswith("failed: never_reached")
        np.testing.assert_array_equal(frames[-1], image)


def test_random_actions_fail(stock_cli: Run, tmp_path: Path) -> None:
    flags = "--policy.type=bomb_random --eval.n_episodes=2 --eval.batch_size=2 --eval.use_async_envs=false"
    assert evaluate(stock_cli, tmp_path, f"{flags} --env.fps=1")["overall"]["pc_success"] == 0.0
    assert all(row.failure for row in read_results(tmp_path / "results.jsonl", EpisodeResult))


def test_vla0_smol_trains_and_its_checkpoint_acts(stock_cli: Run, dataset: Path, tmp_path: Path) -> None:
    flags = "--policy.type=vla0_smol --policy.vlm_model_name=nano --steps=2"
    checkpoint = train(stock_cli, dataset, tmp_path / "train", flags)
    flags = f"--policy.path={checkpoint} {SHORT} --eval.n_episodes=1 --eval.batch_size=1"
    assert evaluate(stock_cli, tmp_path, flags)["overall"]["n_episodes"] == 1
    (row,) = read_results(tmp_path / "results.jsonl", EpisodeResult)
    assert row.is_success or row.failure


def test_a_trained_policy_cannot_see_the_true_state(stock_cli: Run, dataset: Path, tmp_path: Path) -> None:
    flags = "--policy.type=act --policy.push_to_hub=false --policy.pretrained_backbone_weights=null --steps=1"
    flags += " --policy.dim_model=32 --policy.n_heads=2 --policy.dim_feedforward=32"
    checkpoint = train(stock_cli, dataset, tmp_path / "train", flags)
    features = json.loads((checkpoint / "config.json").read_text())["input_features"]
    assert sorted(features) == [
        "observation.images.workspace",
        "observation.images.wrist",
        "observation.state",
    ]
    flags = f"--policy.path={checkpoint} {SHORT} --eval.n_episodes=1 --eval.batch_size=1"
    assert evaluate(stock_cli, tmp_path, flags)["overall"]["n_episodes"] == 1


def test_an_existing_output_folder_is_not_overwritten(stock_cli: Run, dataset: Path, tmp_path: Path) -> None:
    (tmp_path / "train").mkdir()
    with pytest.raises(FileExistsError, match="already exists"):
        train(stock_cli, dataset, tmp_path / "train", "--policy.type=vla0_smol --policy.vlm_model_name=nano")


def test_a_wrong_policy_flag_is_named_by_lerobot_train(
    stock_cli: Run, dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = "--policy.type=vla0_smol --policy.vlm_model_name=nano --policy.chunk_size=3"
    with pytest.raises(SystemExit):
        train(stock_cli, dataset, tmp_path / "train", f"{flags} --policy.n_action_steps=5")
    assert "--policy.n_action_steps=5 must lie in 1..3 (--policy.chunk_size)" in capsys.readouterr().err


def test_a_wrong_env_flag_is_named_by_lerobot_eval(
    stock_cli: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        evaluate(stock_cli, tmp_path, "--policy.type=bomb_expert --env.target=[9,9]")
    assert "--env.target=[9, 9] is off the board; give [row, column], each in 0..4" in capsys.readouterr().err
    assert not (tmp_path / "eval").exists()
