"""Tasks of learn.py: what is to be learnt on one CPU core, and what each policy type gets for it."""

from dataclasses import dataclass

from recipes import POLICY_TYPES

from lerobot_bomb.bomb.board import COLORS, task_id
from lerobot_bomb.bomb.perturbations import NUISANCES
from lerobot_bomb.bomb.suite import templates_of
from lerobot_bomb.bomb.suites import SUITES
from lerobot_bomb.bomb.suites.place import TEMPLATES, targets_of
from lerobot_bomb.conditions import ALL, NONE
from lerobot_bomb.results.bomb import EpisodeResult

PROBE = "keypoint_probe"
RIVALS = ("act", "diffusion")  # LeRobot's; they read no instruction
FIRST_SEED = 200_000  # of the demonstrations; LeRobot evaluates from 1000 on
SHOWN, SEVERAL = "as in the demonstrations", "several left out"
# targets of the split 'train' that no demonstration gives a stone of the colour: one per row and column
LEFT_OUT_PAIRS = {
    "black": ((0, 0), (1, 2), (2, 1), (3, 4), (4, 3)),
    "white": ((0, 1), (1, 4), (2, 0), (3, 3), (4, 2)),
}


@dataclass(frozen=True)
class Bar:
    """Bar that the last checkpoint must reach."""

    success: float  # rate
    cpu_minutes: float  # of the training


@dataclass(frozen=True)
class Training:
    """Training that one policy type gets to learn a task."""

    demonstrations: int
    bar: Bar | None  # None: it is only measured
    steps: int | None = None  # None: its recipe's


@dataclass(frozen=True)
class Part:
    """One recording of a task's merged dataset: so many demonstrations, or static scenes."""

    suite: str
    number: int
    is_static: bool = False
    task_ids: tuple[int, ...] = ()  # of the suite, each from every seed; empty: drawn for each episode
    first_seed: int = FIRST_SEED

    @property
    def name(self) -> str:
        """Name of the recording's folder."""
        tasks = f"_tasks_{'_'.join(map(str, self.task_ids))}" if self.task_ids else ""
        return f"{'scenes' if self.is_static else 'shown'}_{self.suite}{tasks}"


@dataclass(frozen=True)
class Task:
    """Task to be learnt: its task ids, its perturbations, and the training of each policy type."""

    task_ids: tuple[int, ...]  # empty: target and colour are drawn for each episode
    episodes: int  # of each evaluation
    trainings: dict[str, Training]
    perturbations: str = NONE  # of the demonstrations
    conditions: tuple[str, ...] = ()  # that the last checkpoint is evaluated under, beside the nominal one
    is_partial: bool = False  # whether demonstrations leave out what the evaluations ask for as well
    recipe: str | None = None  # the task whose recipes it is learnt by; None: its own
    suite: str = "place"
    is_said_at_once: bool = True  # else the policy is given several instructions, which are not exchanged
    # what is recorded in place of the training's demonstrations; all of it is labelled for pointing
    parts: tuple[Part, ...] = ()
    env_flags: tuple[str, ...] = ()  # with which the environment is recorded and run


# Places named by a relation take many boards to learn, those with a name of their own only a few.
ALL_SUITES = (
    Part("spatial", 48_000, is_static=True, task_ids=(0, 1, 2, 3, 4, 11)),
    Part("spatial", 4_000, is_static=True, task_ids=(5, 6, 7, 8, 9, 10)),
    Part("long", 24_000, is_static=True, task_ids=(0, 1, 2, 6, 7, 10, 11, 12)),
    Part("long", 12_000, is_static=True),
    Part("goal", 14_000, is_static=True),
    Part("object", 14_000, is_static=True),
    Part("place", 5_000, is_static=True),
    Part("spatial", 200),
    Part("object", 150),
    Part("long", 130),
    Part("goal", 100),
    Part("place", 100),
)

TASKS = {
    "one_target": Task(
        (12,),
        episodes=100,
        trainings={
            PROBE: Training(200, Bar(0.90, 120), steps=3000),
            **{name: Training(600, Bar(0.95, 20)) for name in POLICY_TYPES},
            **{name: Training(600, None) for name in RIVALS},
        },
    ),
    "all_targets": Task(
        (),
        episodes=200,
        trainings={
            PROBE: Training(400, None, steps=6000),
            **{name: Training(1600, Bar(0.90, 180)) for name in POLICY_TYPES},
            "spatialvla_grid": Training(3200, Bar(0.90, 180)),
            "vla0_smol": Training(3200, Bar(0.97, 90)),
        },
    ),
    "robust": Task(
        (),
        episodes=200,
        trainings={name: Training(3600, None) for name in POLICY_TYPES},
        perturbations=f"{ALL}:0-4",
        conditions=(*(f"{axis}:3" for axis in NUISANCES), f"{ALL}:1", f"{ALL}:3", f"{ALL}:5"),
    ),
    "left_out": Task(
        (),
        episodes=400,
        trainings={name: Training(1600, None) for name in POLICY_TYPES},
        is_partial=True,
        recipe="all_targets",
    ),
    # one policy for all suites, evaluated on each
    "all_suites": Task(
        (),
        episodes=100,
        trainings={
            name: Training(sum(part.number for part in ALL_SUITES if not part.is_static), None)
            for name in POLICY_TYPES
        },
        suite=ALL,
        is_said_at_once=False,
        parts=ALL_SUITES,
    ),
    **{
        suite: Task(
            (),
            episodes=100,
            trainings={name: Training(1600, None) for name in POLICY_TYPES},
            recipe="all_targets",
            suite=suite,
            is_said_at_once=suite != "long",
        )
        for suite in SUITES
        if suite != "place"
    },
}


def shown_pairs() -> list[int]:
    """Task ids of the split 'train' without those of LEFT_OUT_PAIRS."""
    return [
        task_id(target, color)
        for color in COLORS
        for target in targets_of("train")
        if target not in LEFT_OUT_PAIRS[color]
    ]


def by_suite(rows: list[EpisodeResult]) -> dict[str, list[EpisodeResult]]:
    """Return {suite: its records} of an evaluation on several suites; {} on one."""
    suites = sorted({row.spec.suite for row in rows})
    each = {suite: [row for row in rows if row.spec.suite == suite] for suite in suites}
    return each if len(suites) > 1 else {}


def by_what_is_left_out(rows: list[EpisodeResult]) -> dict[str, list[EpisodeResult]]:
    """Group records by what of their episode no demonstration showed."""
    groups: dict[str, list[EpisodeResult]] = {}
    for row in rows:
        target, color = row.target, row.color
        assert target is not None and color is not None  # each episode of `place` has both
        wordings = [
            template.format(color=color, row=target[0], column=target[1])
            for template in templates_of("heldout", TEMPLATES)
        ]
        left_out = {
            "target left out": target in targets_of("heldout"),
            "wording left out": row.instruction in wordings,
            "colour for this target left out": target in LEFT_OUT_PAIRS[color],
        }
        names = [name for name, is_left_out in left_out.items() if is_left_out] or [SHOWN]
        groups.setdefault(names[0] if len(names) == 1 else SEVERAL, []).append(row)
    return dict(sorted(groups.items()))
