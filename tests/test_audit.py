"""``lerobot-bomb audit``: what was planted in a policy is what it says."""

import json
from pathlib import Path

import pytest
from result_rows import read, values

from lerobot_bomb.commands.arguments import ANSWER_IS_NO
from lerobot_bomb.commands.main import main
from lerobot_bomb.report.verdicts import (
    AGAIN,
    ALONE,
    BLANK,
    EXPERT,
    HELDOUT,
    NO,
    OPEN,
    OTHER_INSTRUCTION,
    POLICY,
    RANDOM,
    TRAIN,
    YES,
    judge,
)
from lerobot_bomb.results.record import Record

N = 40
type Records = list[Record]


def records(successes: int, shift: float = 0.0, n: int = N, first: int = 0) -> Records:
    """Episodes of which the first succeed; another shift is another episode, bit for bit."""
    return [
        read(values(seed, None if seed - first < successes else "imprecise", 1.0 + shift))
        for seed in range(first, first + n)
    ]


@pytest.fixture
def arms() -> dict[str, Records]:
    """Return the arms of a policy that has nothing to hide."""
    return {
        POLICY: records(36),
        AGAIN: records(36),
        ALONE: records(36, 0.01),
        BLANK: records(0, 0.5),
        OTHER_INSTRUCTION: records(2, 0.5),
        RANDOM: records(0, 0.7),
        EXPERT: records(N, 0.2),
        TRAIN: records(36),
        HELDOUT: records(35),
    }


def answers(arms: dict[str, Records], trained: range | None = range(1000, 2000)) -> dict[str, str]:
    return {verdict.question: verdict.answer for verdict in judge(arms, trained)}


def test_a_policy_that_has_nothing_to_hide_passes(arms: dict[str, Records]) -> None:
    found = answers(arms)
    assert len(found) == 8 and set(found.values()) == {YES}


@pytest.mark.parametrize(
    ("question", "planted"),
    [
        ("reads the instruction", {OTHER_INSTRUCTION: records(36)}),
        ("looks at the images", {BLANK: records(36)}),
        ("the same flags give the same episodes", {AGAIN: [*records(36)[:-1], *records(0, 0.1, 1, N - 1)]}),
        ("the batch size does not change the success rate", {ALONE: records(20, 0.01)}),
        ("every episode can be solved", {EXPERT: records(N - 1)}),
        ("does as well on what is held out", {HELDOUT: records(4)}),
    ],
)
def test_what_was_planted_is_told_and_nothing_else(
    question: str, planted: dict[str, Records], arms: dict[str, Records]
) -> None:
    found = answers(arms | planted)
    assert found.pop(question) == NO
    assert set(found.values()) == {YES}


def test_what_these_episodes_do_not_show_is_left_open(arms: dict[str, Records]) -> None:
    found = answers(arms | {OTHER_INSTRUCTION: records(34, 0.1), RANDOM: records(35, 0.7)}, None)
    assert [question for question, answer in found.items() if answer == OPEN] == [
        "reads the instruction", "better than random actions", "evaluates only episodes outside the training",
    ]  # fmt: skip


def test_a_batch_of_one_is_not_asked_about(arms: dict[str, Records]) -> None:
    del arms[ALONE]
    assert "the batch size does not change the success rate" not in answers(arms)


def test_tasks_that_share_seeds_are_paired_task_by_task() -> None:
    def tasks(shift: float) -> Records:
        spec = {"color": "black"}
        return [
            read(
                values(
                    seed,
                    None if target == (0, 0) else "imprecise",
                    1.0 + shift,
                    spec=spec | {"target": target},
                )
            )
            for target in ((0, 0), (1, 1))
            for seed in range(20)
        ]

    arms = {POLICY: tasks(0.0), AGAIN: tasks(0.0), ALONE: tasks(0.01)}
    found = {verdict.question: verdict for verdict in judge(arms, None)}
    assert found["the same flags give the same episodes"].evidence == "40 of 40, bit for bit"
    alone = found["the batch size does not change the success rate"]
    assert alone.evidence.startswith("0 of 40 episodes end otherwise (p = 1, not adjusted)")


def test_seeds_of_the_training_are_found(arms: dict[str, Records]) -> None:
    verdict = judge(arms, range(30, 60))[-1]
    assert verdict.answer == NO and verdict.evidence == "trained on seeds 30..59, 10 evaluated"


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--episodes=1"], "--episodes=1 must be at least 2"),
        (["--eval.n_episodes=3"], "--eval.n_episodes is set for every job"),
        (["--env.task=long"], "--env.task=long has episodes whose instruction changes"),
    ],
)
def test_wrong_flags_are_told(
    flags: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["audit", str(tmp_path), "--policy.path=bomb:fdvla", *flags]) == 1
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.long
def test_the_shipped_policy_and_one_that_is_told_nothing(tmp_path: Path) -> None:
    from lerobot_bomb.explain.interventions import ReplaceTasks, intervene

    flags = ["--env.image_size=64", "--policy.device=cpu", "--episodes=20", "--workers=2"]
    assert main(["audit", str(tmp_path / "honest"), "--policy.path=bomb:fdvla", *flags]) == 0
    answers = read_answers(tmp_path / "honest")
    assert answers["reads the instruction"] == answers["looks at the images"] == YES
    # whatever it is told, it is given one and the same instruction
    lines = (tmp_path / "honest" / "first" / "results.jsonl").read_text().splitlines()
    told = {json.loads(line)["instruction"] for line in lines}
    deaf = ReplaceTasks(dict.fromkeys(told, min(told)))
    intervene("bomb:fdvla", [deaf], tmp_path / "deaf")
    flags += ["--env.split=all"]  # no other splits, whose instructions it does not know
    command = ["audit", str(tmp_path / "audit"), f"--policy.path={tmp_path / 'deaf'}", *flags]
    assert main(command) == ANSWER_IS_NO
    answers = read_answers(tmp_path / "audit")
    assert answers["reads the instruction"] == NO and answers["looks at the images"] != NO


def read_answers(folder: Path) -> dict[str, str]:
    section = json.loads((folder / "audit.json").read_text())
    return {question: answer for question, answer, _ in section["tables"][0]["rows"]}
