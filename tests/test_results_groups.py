"""Episodes that are pooled, paired or kept apart, and the summary and heading of each group."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from result_rows import ACT, FDVLA, old_row, printed, row

from lerobot_bomb.bomb.board import COLORS
from lerobot_bomb.bomb.episode import PROTOCOL_VERSION
from lerobot_bomb.checkpoints.shipped import shipped_checkpoint, shipped_names
from lerobot_bomb.commands.main import main
from lerobot_bomb.results.bomb import EpisodeResult, median_error_mm
from lerobot_bomb.results.groups import read_results
from lerobot_bomb.results.names import policy_names
from lerobot_bomb.results.origin import PolicyIdentity
from lerobot_bomb.results.summary import summarise


def test_summary_counts_successes_errors_and_failures(path: Path) -> None:
    lines = [row(0), row(1, error=3.0), row(2, "imprecise", 14.0), row(3, "never_reached", 200.0)]
    lines += [row(4, "dropped", 99.0), row(5, "wrong_intersection", 45.0), row(6, "disturbed_others", 2.0)]
    path.write_text("".join(lines))
    records = read_results(path, EpisodeResult)
    summary = summarise([*records])
    assert (summary.rate.n, summary.rate.successes) == (7, 2)
    assert median_error_mm(records) == 3.0  # of 1, 2, 3, 14 and 45: only stones that were put down
    assert summary.failures == {
        "imprecise": 1,
        "never_reached": 1,
        "dropped": 1,
        "wrong_intersection": 1,
        "disturbed_others": 1,
    }


def test_an_episode_that_was_run_again_counts_once(path: Path) -> None:
    path.write_text(row(0, "dropped") + row(1) + row(0))
    assert summarise(read_results(path)).rate.successes == 2


def test_moves_made_are_shown_of_episodes_with_several(path: Path) -> None:
    several = {"target": None, "color": None, "spec": {"suite": "long"}}
    path.write_text(row(0, progress=1.0, **several) + row(1, "dropped", progress=0.5, **several))
    (line,) = [line for line in summarise(read_results(path)).lines() if line.startswith("moves made")]
    assert "75.0 %" in line
    path.write_text(row(0))
    assert not any(line.startswith("moves made") for line in summarise(read_results(path)).lines())


def test_the_command_prints_a_summary(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = printed(path, row(0) + row(1, "dropped"), capsys)
    assert "1/2 = 50.0 %" in output
    assert "dropped 1" in output


@pytest.mark.parametrize("of_old", [{"task_version": "1.0"}, {"protocol_version": "1.0"}])
def test_results_of_different_task_versions_are_not_pooled(
    of_old: dict[str, str], path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    of_object: dict[str, Any] = {"spec": {"suite": "object"}}
    new = [row(seed, task_version="1.1", **of_object) for seed in (0, 1)]
    make_row: Callable[..., str] = old_row if "protocol_version" in of_old else row
    old = make_row(2, **of_object | of_old)
    output = printed(path, "".join(new) + old, capsys)
    assert f"{path}: 2 episodes" in output and f"{path}: 1 episode" in output
    assert re.search(r"2 groups of episodes, .* they differ in .*task_version", output)


def checkpoint(policy_type: str, path: str | None, digit: str = "0", **other: Any) -> PolicyIdentity:
    return PolicyIdentity(policy_type, path, weights_sha256=digit * 64, **other)


LAST = "checkpoints/last/pretrained_model"


@pytest.mark.parametrize(
    ("policies", "names"),
    [
        ([checkpoint("act", f"outputs/a/{LAST}"), PolicyIdentity("bomb_random")], ["act", "bomb_random"]),
        ([checkpoint("act", f"/x/a/{LAST}"), checkpoint("act", f"/x/b/{LAST}")], ["act a", "act b"]),
        ([checkpoint("act", "/x/010/m"), checkpoint("act", "/x/020/m")], ["act 010", "act 020"]),
        ([checkpoint("act", "/x/a"), checkpoint("act", "/x/a/b")], ["act", "act b"]),
        ([checkpoint("act", None), checkpoint("act", "x/a")], ["act", "act x/a"]),
        ([checkpoint("act", "x", "1"), checkpoint("act", "x", "2")], ["act 111111", "act 222222"]),
        (
            [checkpoint("act", "x"), checkpoint("act", "x", interventions=("ReplaceTasks",))],
            ["act", "act with ReplaceTasks"],
        ),
        (
            [PolicyIdentity("act", is_in_training=True, training_step=step) for step in (None, 20, 40)],
            ["act", "act step 20", "act step 40"],
        ),
        ([None, PolicyIdentity("a"), PolicyIdentity("a")], ["policy not recorded", "a (1)", "a (2)"]),
    ],
)
def test_a_policy_has_the_shortest_name_that_tells_it_from_the_others(
    policies: list[PolicyIdentity | None], names: list[str]
) -> None:
    assert policy_names(policies) == names


def test_a_shipped_policy_is_named_as_on_the_command_line_and_a_given_name_wins() -> None:
    shipped = [checkpoint(name, str(shipped_checkpoint(name))) for name in shipped_names()]
    names = [f"bomb:{name}" for name in shipped_names()]
    assert policy_names(shipped) == names
    assert policy_names([*shipped, checkpoint("act", "x")], {shipped[0].key: "ours"}) == [
        "ours",
        *names[1:],
        "act",
    ]


OTHER: dict[str, dict[str, Any]] = {
    "policy": {"policy": FDVLA},
    "protocol": {"protocol_version": "1.0"},
    "MuJoCo": {"mujoco_version": "3.9.0"},
    "OpenGL": {"opengl_renderer": "NVIDIA H200/PCIe/SSE2"},
    "image_size": {"image_size": 64},
    "render_preset": {"render_preset": "shadows"},
    "tasks": {"task_ids": [12]},
    "fps": {"spec": {"fps": 20}},
    "split": {"spec": {"split": "train"}},
    "robot": {"spec": {"robot": "fetch"}},
    "control_mode": {"spec": {"control_mode": "absolute"}},
    "success_tolerance_mm": {"spec": {"success_tolerance_mm": 5.0}},
}


@pytest.mark.parametrize("name", OTHER)
def test_what_does_not_compare_is_neither_pooled_nor_paired_and_named(
    name: str, path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spec = OTHER[name].get("spec", {}) | {"perturbations": "camera:3"}
    perturbed = [row(seed, "dropped", **(OTHER[name] | {"spec": spec})) for seed in (0, 1, 2)]
    output = printed(path, row(0) + row(1) + "".join(perturbed), capsys)
    assert (
        f"2 groups of episodes, neither pooled nor paired with each other; they differ in {name}\n" in output
    )
    assert f"{path}: 2 episodes" in output
    assert f"{path}: 3 episodes" in output
    assert "perturbed episodes without an unperturbed one to compare with: 3" in output
    assert "pairs," not in output
    if "spec" not in OTHER[name]:  # then the episodes are the same
        assert f"those of this file differ in {name}" in output


def test_steps_of_a_training_are_not_pooled(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    early, late = (PolicyIdentity("act", is_in_training=True, training_step=step) for step in (20, 40))
    text = of_evaluation(range(20), 20, failure="dropped", policy=early)
    output = printed(path, text + of_evaluation(range(7), 20, policy=late), capsys)
    assert "0/20" in output and "7/7" in output and "policy act (in training, step 40)" in output


def test_two_policies_are_two_groups_with_pairs_of_their_own(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    retrained = PolicyIdentity("act", "outputs/act", None, "e" * 64, "b" * 64)
    moved = PolicyIdentity("act", "elsewhere", None, "a" * 64, "b" * 64)
    text = "".join(
        row(seed, failure, spec={"perturbations": condition}, policy=policy)
        for seed in (0, 1)
        for policy, failure in ((ACT, None), (retrained, "dropped"))
        for condition in ("none", "all:5")
    )
    output = printed(path, text + row(2, policy=moved), capsys)
    headings = [f"policy act outputs/act (weights {sha * 12}, settings bbbbbbbbbbbb)" for sha in "ae"]
    first, second = (output.index(heading) for heading in headings)
    assert "3/3 = 100.0 %" in output[first:second]
    assert "0/2 = 0.0 %" in output[second:]
    assert output[first:second].count("all:5: 2 pairs") == output[second:].count("all:5: 2 pairs") == 1
    assert "count no more" not in output


def test_one_target_and_all_targets_are_not_six_episodes(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one = [row(seed, spec={"target": (2, 2), "color": "black"}, task_ids=[12]) for seed in range(3)]
    every = [row(seed, "dropped", policy=FDVLA) for seed in range(3)]
    output = printed(path, "".join(one + every), capsys)
    assert "6 episodes" not in output
    assert "they differ in policy, tasks" in output
    assert "policy act outputs/act (weights aaaaaaaaaaaa, settings bbbbbbbbbbbb); tasks 12\n" in output
    assert (
        "policy fdvla me/fdvla@0123456789ab (weights cccccccccccc, settings dddddddddddd); target drawn; "
        in output
    )


@pytest.mark.parametrize("line", [row, old_row])
def test_numbered_tasks_are_one_set(line: Any, path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    specs = [{"target": divmod(i % 25, 5), "color": COLORS[i // 25]} for i in range(50)]
    task_ids = {"task_ids": list(range(50))} if line is row else {}
    lines = [line(7, spec=spec, **task_ids).strip() for spec in specs]
    output = printed(path, "\n".join(lines), capsys)
    assert "tasks 0..49\n" in output
    assert ": 50 episodes" in output
    assert "groups" not in output


def test_a_heading_says_what_was_asked(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    spec = {"target": (1, 3), "robot": "fetch", "perturbations": "camera:3"}
    text = "".join(row(0, spec=spec | {"seed": seed}, color="white") for seed in (4, 7, 4))
    output = printed(path, text, capsys)
    assert "target row 1, column 3; colour drawn" in output
    assert (
        f"protocol {PROTOCOL_VERSION}, suite=place, robot=fetch, split=all, control_mode=relative, " in output
    )
    assert "perturbations=camera:3, seeds 4, 7" in output
    assert "256 px, render_preset fast, OpenGL Mesa, llvmpipe, MuJoCo 3.8.1, lerobot_bomb " in output
    assert "1 records are replaced by later ones of the same episode" in output
    assert 'without an unperturbed one to compare with: 2; add "none" to --env.perturbations' in output


def test_a_perturbed_arm_is_compared_with_the_same_episodes_unperturbed(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    outcomes = {"none": "++++++-", "camera:3": "-----++", "all:5": "++"}  # by seed
    lines = [
        row(seed, None if outcome == "+" else "dropped", spec={"perturbations": condition})
        for condition, marks in outcomes.items()
        for seed, outcome in enumerate(marks)
    ]
    lines.append(row(99, spec={"perturbations": "all:5"}))  # has no pair
    output = printed(path, "".join(lines), capsys)
    test = "(exact McNemar test, adjusted for 2 conditions (Holm))"
    assert f"camera:3: 7 pairs, 5 lost, 1 won, p = 0.44 {test}" in output  # 2 x 0.21875
    assert f"all:5: 2 pairs, 0 lost, 0 won, p = 1 {test}" in output
    assert "without an unperturbed one to compare with: 1; add" in output
    assert f"{path} (perturbations=none): 7 episodes" in output


def test_numbered_tasks_of_one_seed_are_clusters(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    specs = [{"target": divmod(task, 5), "color": "black"} for task in range(6)]
    lines = [
        row(seed, None if seed % 2 else "dropped", spec=spec, task_ids=list(range(6)))
        for seed in range(4)
        for spec in specs
    ]
    # as four records, two of them successes, with Student's t for 3 degrees of freedom: 3.182
    expected = "success          12/24 = 50.0 % [7.7, 92.3] (95 % Wilson interval, 4 clusters by seed)"
    assert expected in printed(path, "".join(lines), capsys)
    expected = "success          3/6 = 50.0 % (no interval: all are of one seed)"
    failures = [None, "dropped"] * 3
    one = [
        row(0, failure, spec=spec, task_ids=list(range(6)))
        for failure, spec in zip(failures, specs, strict=True)
    ]
    assert expected in printed(path, "".join(one), capsys)


CAMERA = {"perturbations": "camera:3"}


def of_evaluation(seeds: range, num_episodes: int, seed: int = 0, **other: Any) -> str:
    """Write rows of these seeds, of an evaluation of so many episodes from `seed` on."""
    evaluation = {"num_episodes": num_episodes, "seed": seed}
    return "".join(row(each, evaluation=evaluation, **other) for each in seeds)


def of_tasks(numbers: list[int], num_episodes: int, **spec: Any) -> str:
    """Write rows of numbered tasks, so many of each, of one evaluation."""
    return "".join(
        of_evaluation(range(number), num_episodes, spec={"suite": "object", "task_id": task_id} | spec)
        for task_id, number in enumerate(numbers)
    )


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (of_evaluation(range(7), 20), "7 of 20"),
        (of_evaluation(range(20), 20), ""),
        ("".join(map(row, range(7))), ""),  # of an earlier release
        (row(0) + of_evaluation(range(1, 8), 20), "7 of 20"),
        # begun again: once with another stop, once to the end, once with more episodes
        (of_evaluation(range(7), 20) + of_evaluation(range(3), 20), "7 of 20"),
        (of_evaluation(range(7), 20) + of_evaluation(range(20), 20), ""),
        (of_evaluation(range(7), 20) + of_evaluation(range(50), 50), ""),
        # of other seeds, of another policy
        (of_evaluation(range(7), 20) + of_evaluation(range(100, 109), 10, seed=100), "7 of 20 and 9 of 10"),
        (of_evaluation(range(7), 20) + of_evaluation(range(13), 20, policy=FDVLA), "7 of 20 and 13 of 20"),
        # several conditions or suites of one evaluation
        (
            of_evaluation(range(7), 14) + of_evaluation(range(4), 14, spec={"perturbations": "all:3"}),
            "11 of 14",
        ),
        (of_evaluation(range(7), 14) + of_evaluation(range(4), 14, spec={"suite": "object"}), "11 of 14"),
        # beside a whole one of another condition; of it, but for one task
        (of_evaluation(range(20), 20) + of_evaluation(range(5), 20, spec=CAMERA), "5 of 20"),
        (of_evaluation(range(20), 20) + of_evaluation(range(10), 20, spec=CAMERA), "10 of 20"),
        (of_evaluation(range(15), 20) + of_evaluation(range(15), 20, spec=CAMERA), "15 of 20 and 15 of 20"),
        (of_tasks([20, 20], 40) + of_tasks([20, 10], 40, **CAMERA), "30 of 40"),
        # begun again after another condition; one condition alone with more episodes
        (
            of_evaluation(range(5), 20)
            + of_evaluation(range(20), 20, spec=CAMERA)
            + of_evaluation(range(20), 20),
            "",
        ),
        (
            of_evaluation(range(20), 40)
            + of_evaluation(range(20), 40, spec=CAMERA)
            + of_evaluation(range(40), 40),
            "",
        ),
    ],
)
def test_episodes_that_an_evaluation_lacks_are_told(
    text: str, expected: str, path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path.write_text(text)
    assert main(["results", str(path)]) == 0
    told = f"{path}: {expected} episodes played; lerobot-eval was stopped, or still runs\n"
    assert capsys.readouterr().err == (told if expected else "")
    page = path.with_suffix(".html")
    assert main(["report", str(path), f"--output={page}"]) == 0
    assert ("episodes played" in page.read_text()) is bool(expected)
