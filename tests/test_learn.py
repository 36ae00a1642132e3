import json
import subprocess
import sys
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import learn
import learning_tasks
import numpy as np
import pytest
from learning_curve import SUCCESS, count, draw
from result_rows import read, values

from lerobot_bomb.bomb.board import COLORS
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.suite import specs_of_tasks, templates_of
from lerobot_bomb.bomb.suites.place import TEMPLATES, targets_of
from lerobot_bomb.checkpoints.identity import sha256_of
from lerobot_bomb.commands.main import main as lerobot_bomb
from lerobot_bomb.results.bomb import EpisodeResult

SIZE = 32  # pixels

# The task as a whole


@pytest.fixture
def commands(monkeypatch: pytest.MonkeyPatch, stock_cli: Callable[..., None]) -> list[str]:
    """A tiny task whose commands run in this process; the list of those that ran."""
    ran = []

    def run(command: str, *flags: str) -> None:
        ran.append(command)
        if command == "lerobot-bomb":
            assert lerobot_bomb(flags) == 0
        elif command == "lerobot-train":
            assert "--policy.num_channels=8" in flags
            stock_cli(command, *flags)
        else:
            short = ["--env.fps=2", "--env.ignore_checkpoint=true"]
            stock_cli(command, *flags, *short, "--eval.batch_size=1")

    training = learning_tasks.Training(demonstrations=1, bar=learn.Bar(0.5, cpu_minutes=5), steps=2)
    tiny = learn.Task((), episodes=2, trainings={learn.PROBE: training}, is_partial=True)
    for name, value in {"run_command": run, "TASKS": {"tiny": tiny}, "IMAGE_SIZE": SIZE}.items():
        monkeypatch.setattr(learn, name, value)
    monkeypatch.setattr(learn, "BATCH_SIZE", 2)
    cpu_s = iter((100.0, 220.0))  # before and after the training
    monkeypatch.setattr(learn, "_children_cpu_s", lambda: next(cpu_s))
    return ran


def test_a_folder_is_in_use_until_the_commands_of_a_killed_run_have_ended(tmp_path: Path) -> None:
    left = [sys.executable, "-c", "import sys; sys.stdin.read()"]
    with learn.locked(tmp_path):
        command = subprocess.Popen(left, stdin=subprocess.PIPE, close_fds=False)
    with pytest.raises(RuntimeError, match="is in use"), learn.locked(tmp_path):
        pass
    command.communicate()
    with learn.locked(tmp_path):
        pass


@pytest.mark.long
def test_a_task_is_learnt_by_stock_commands_and_goes_on_where_it_stopped(
    commands: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "task"
    args = Namespace(
        task="tiny",
        policy_type=learn.PROBE,
        checkpoints=2,
        first_seed=100_000,
        output_dir=folder,
        demonstrations=None,
        steps=None,
        plot=tmp_path / "curve.png",
        json=tmp_path / "learn.json",
        policy_flags=["--policy.num_channels=8"],
    )
    assert learn.run_task(args) == 1  # two steps of training teach nothing
    assert commands == ["lerobot-bomb", "lerobot-train", *["lerobot-eval"] * 4]
    figures = json.loads(args.json.read_text())
    assert [(name, point["step"]) for name, point in figures["points"].items()] == [
        ("step 1", 1),
        ("step 2", 2),
        (learn.NO_IMAGES, 2),
        (learn.OTHER_INSTRUCTION, 2),
        ("colour for this target left out", 2),
        ("target left out", 2),
    ]
    recorded = json.loads((folder / "dataset" / "meta" / "bomb.json").read_text())["recording"]
    assert recorded["task_ids"] == learning_tasks.shown_pairs()
    weights = {
        str(int(path.name)): sha256_of(path / "pretrained_model" / "model.safetensors")
        for path in (folder / "train" / "checkpoints").glob("0*")
    }
    assert figures["weights_sha256"] == weights
    assert figures["training"]["cpu_minutes"] == 2.0
    assert figures["points"]["step 1"]["cpu_minutes"] == 1.0
    assert all(point["num_episodes"] == 2 for name, point in figures["points"].items() if "step" in name)
    printed = capsys.readouterr().out
    assert "To be reached: 50 % within 5 CPU minutes: MISSED" in printed
    assert f"lerobot-bomb view --policy.path={folder / 'train' / 'checkpoints' / 'last'}" in printed

    commands.clear()
    (folder / "eval_000002" / "finished").unlink()
    assert learn.run_task(args) == 1
    assert commands == ["lerobot-eval"]
    assert len((folder / "eval_000002" / "results.jsonl").read_text().splitlines()) == 2

    args.steps = 4
    with pytest.raises(RuntimeError, match=r'holds a run of .*"steps": 2.*; name another folder'):
        learn.run_task(args)


def test_a_stone_counts_where_the_given_instruction_says() -> None:
    rows = [
        row(None, 1.0, instruction="a"),
        row("wrong_intersection", 45.0, (2, 3), instruction="a"),
        row("dropped", 45.0, (2, 3), instruction="a"),
        row(None, 1.0, (2, 3), instruction="b", target=[2, 3]),
    ]
    given = learn.other_instructions(rows)
    assert given == {"a": "b", "b": "a"}
    # of the first three, what the fourth names
    targets = learn.named_targets(rows)
    assert learn.count_named(rows, given, targets) == learn.count_named(rows[:3], given, targets) == 1
    assert learn.count_named(rows, {"a": "a", "b": "b"}, targets) == 2


def test_every_policy_type_has_a_recipe_for_every_task() -> None:
    for name, task in learn.TASKS.items():
        for policy_type in task.trainings.keys() - {learn.PROBE}:
            recipe = learn.read_recipe(learn.recipe_task(name), policy_type)
            policy = recipe["policy"]
            if name == "robust":
                assert policy["path"] == "learn_all/train/checkpoints/last/pretrained_model"
            else:
                assert policy["type"] == policy_type
            if policy_type not in learning_tasks.RIVALS:
                assert recipe["policy"]["scheduler_decay_steps"] == recipe["steps"]


def test_parts_of_a_task_are_recorded_and_merged(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    dataset, ran = tmp_path / "dataset", []

    def run(*command: str) -> None:
        ran.append(command)
        roots = [flag.split("=")[1] for flag in command if flag.startswith("--root=")]
        Path(roots[0]).mkdir()

    monkeypatch.setattr(learn, "run_command", run)
    parts = (learn.Part("goal", 3), learn.Part("spatial", 400, is_static=True, task_ids=(0, 11)))
    task = learn.Task((), episodes=1, trainings={}, suite="all", parts=parts)
    (tmp_path / "shown_goal").mkdir()  # by a run that was stopped
    learn.record(task, 3, dataset)
    scenes, merge = ran
    folder = tmp_path / "scenes_spatial_tasks_0_11"
    assert {"--static=400", "--pointing", "--task=spatial", "--task_ids=[0, 11]", f"--root={folder}"} <= set(
        scenes
    )
    assert not any(flag.startswith(("--noise", "--episodes")) for flag in scenes)
    assert merge[1:5] == ("record", "merge", str(tmp_path / "shown_goal"), str(folder))
    assert dataset.is_dir()


def test_an_evaluation_of_several_suites_has_a_row_for_each() -> None:
    rows = [row(None, 1.0, spec={"suite": suite}) for suite in ("place", "spatial", "place")]
    assert learn.by_suite(rows) == {"spatial": rows[1:2], "place": rows[::2]}
    assert learn.by_suite(rows[:1]) == {}


def test_demonstrations_leave_out_targets_wording_and_colours() -> None:
    shown = specs_of_tasks(EpisodeSpec(seed=0), learning_tasks.shown_pairs())
    # every target of the split, and beside it each row and column in each colour
    assert {spec.target for spec in shown} == set(targets_of("train"))
    for color in COLORS:
        targets = [spec.target for spec in shown if spec.color == color and spec.target is not None]
        assert len(targets) == 15
        assert {row for row, _ in targets} == {column for _, column in targets} == set(range(5))

    def episode(target: tuple[int, int], color: str, template: str) -> EpisodeResult:
        instruction = template.format(color=color, row=target[0], column=target[1])
        return row(None, 1.0, target, target=target, color=color, instruction=instruction)

    wordings = [templates_of(split, TEMPLATES)[0] for split in ("train", "heldout")]
    groups = {
        (target, color, wording): next(
            iter(learning_tasks.by_what_is_left_out([episode(target, color, wording)]))
        )
        for target, color, wording in (
            ((0, 0), "white", wordings[0]),
            ((0, 0), "black", wordings[0]),
            ((0, 0), "white", wordings[1]),
            ((0, 3), "white", wordings[0]),
            ((0, 3), "white", wordings[1]),
        )
    }
    assert list(groups.values()) == [
        learning_tasks.SHOWN,
        "colour for this target left out",
        "wording left out",
        "target left out",
        learning_tasks.SEVERAL,
    ]


def test_a_bar_is_of_success_and_of_time() -> None:
    point = count([row(None, 1.0)] * 9 + [row("dropped", 1.0)], step=1, cpu_minutes=4.0)
    assert learn.verdict(point, learn.Bar(0.9, cpu_minutes=4)) == 0
    assert learn.verdict(point, learn.Bar(0.91, cpu_minutes=4)) == 1
    assert learn.verdict(point, learn.Bar(0.9, cpu_minutes=3.9)) == 1


# The curve


def row(
    failure: str | None, error_mm: float, nearest: tuple[int, int] = (2, 2), **other: Any
) -> EpisodeResult:
    """Return the record of an episode; a stone that is not placed was lifted."""
    return read(values(0, failure, error_mm, nearest_intersection=nearest, **other))


def test_a_point_counts_grounding_and_precision_apart() -> None:
    rows = [
        row(None, 1.0),
        row(None, 4.0),
        row("imprecise", 15.0),
        row("imprecise", 22.0),
        row("disturbed_others", 2.0, stage="placed"),
        row("wrong_intersection", 45.0, (2, 3)),
        row("dropped", 5.0),
        row("missed_grasp", 170.0, (2, 4), stage="grasped"),
    ]
    point = count(rows, step=100, cpu_minutes=2.5)
    assert (point.step, point.cpu_minutes, point.num_episodes) == (100, 2.5, 8)
    assert (point.num_successes, point.num_lifted) == (2, 7)
    assert (point.num_grounded, point.num_precise) == (5, 3)
    assert point.median_error_mm == 9.5  # of 1, 2, 4, 15, 22 and 45
    assert count([row("dropped", 5.0)], 1, 1.0).median_error_mm is None


def test_the_plot_shows_a_curve_that_rises(tmp_path: Path) -> None:
    points = [
        count([row("imprecise", 12.0)] * 10, 1, 1.0),
        count([row(None, 1.0)] * 10, 2, 2.0),
    ]
    draw(points, "title", tmp_path / "new" / "curve.png")
    plot = cv2.imread(str(tmp_path / "new" / "curve.png"))
    assert plot is not None
    blue_green_red = [*bytes.fromhex(SUCCESS[1:])][::-1]
    lines, columns = np.nonzero((plot == blue_green_red).all(axis=2))
    first, last = columns.argmin(), columns.argmax()
    assert columns[last] - columns[first] > plot.shape[1] / 3
    assert lines[first] - lines[last] > plot.shape[0] / 2
