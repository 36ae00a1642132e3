"""Suites: each is a kind of episode, and has a file in `suites/`."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from lerobot_bomb.bomb.board import COLORS, Intersection
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.go import is_legal_move
from lerobot_bomb.bomb.layout import Layout
from lerobot_bomb.bomb.move import Aim, Plan
from lerobot_bomb.bomb.streams import Stream, generator
from lerobot_bomb.bomb.suites import OWN_SUITES, SUITES
from lerobot_bomb.conditions import ALL
from lerobot_bomb.flags import one_of

FIRST_VERSION = "1.0"  # of every suite, and of lines and recordings that name none
NUM_TRAINED_TEMPLATES = 3  # the first ones of a suite; the others are held out


@dataclass(frozen=True)
class Turn:
    """Instruction that is given after a number of moves."""

    instruction: str
    # words for the stone, the place or the command in the suite's templates and forms
    words: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Episode:
    """Episode that an EpisodeSpec determines."""

    spec: EpisodeSpec
    task_id: int  # number of its task in the suite
    turns: tuple[Turn, ...]  # one, or one for each move
    opening: Mapping[Intersection, str]  # colours of the stones that stand on the board
    layout: Layout
    supply: tuple[int, ...]  # indices of the stones that lie in the tray
    plans: tuple[Plan, ...]  # any one of which fulfils the instruction
    aims: tuple[Aim, ...]  # of the expert, in its order
    target: Intersection | None = None  # if there is one move to one intersection
    color: str | None = None  # of the stone, where it is moved from the tray to the target
    # whether the instruction still means these plans with these stones on the board
    is_clear: Callable[[Mapping[Intersection, str]], bool] = lambda stones: True
    extra_colors: tuple[str, ...] = COLORS  # of stones that may join the opening
    # whether the instruction names the gripper: it must stay true where the gripper starts elsewhere
    gripper_is_named: bool = False
    pattern: Mapping[Intersection, str] = field(
        default_factory=dict
    )  # what the small board in the tray shows

    @property
    def instruction(self) -> str:
        """Instruction at the start."""
        return self.turns[0].instruction

    def instruction_after(self, num_moves: int) -> str:
        """Return the instruction after this number of moves."""
        return self.turns[min(num_moves, len(self.turns) - 1)].instruction

    def allows(self, stones: Mapping[Intersection, str]) -> bool:
        """Return True if the move is legal, and the instruction clear, with these stones on the board."""
        if self.target is not None and self.color is not None:
            return is_legal_move(dict(stones), self.target, self.color) and self.is_clear(stones)
        return self.is_clear(stones)


@dataclass(frozen=True)
class Suite:
    """Kind of episode: how its episodes are drawn and how long they may last.

    ``check`` raises a ValueError that names the flag if no episode can be drawn from a spec.
    """

    sample: Callable[[EpisodeSpec], Episode]  # the same spec gives the same episode; without perturbations
    check: Callable[[EpisodeSpec], None]
    max_steps: int  # at DEFAULT_FPS; scaled with fps
    # form of the language axis -> its templates, of `Turn.words` and coordinates
    forms: tuple[tuple[str, ...], ...]
    num_tasks: int
    # a numbered task's spec
    of_task: Callable[[EpisodeSpec, int], EpisodeSpec] = lambda spec, task_id: replace(spec, task_id=task_id)
    num_goals: int = 1  # of the expert, at most
    # of task, physics, observation and success rule; recordings and results of two versions do not compare
    version: str = FIRST_VERSION


def find_suite(name: str) -> Suite:
    """Return the suite of a name in SUITES."""
    return SUITES[name]


def task_version(name: str) -> str:
    """Return the version of a suite; for `all`, the newest of its suites."""
    return max(find_suite(each).version for each in suites_of(name))


def suites_of(name: str) -> tuple[str, ...]:
    """Return the suites that a flag's value names: one, or `all`.

    Raises:
        ValueError: there is no such suite.
    """
    one_of("--env.task", name, (*SUITES, ALL))
    return OWN_SUITES if name == ALL else (name,)


def of_split[T](split: str, items: Sequence[T], heldout: Sequence[T]) -> tuple[T, ...]:
    """Return the items that a split draws from: those held out, the others, or all."""
    return tuple(item for item in items if split == "all" or (item in heldout) == (split == "heldout"))


def templates_of(split: str, templates: Sequence[str]) -> tuple[str, ...]:
    """Return those of a suite's instruction templates that a split draws from."""
    return of_split(split, templates, templates[NUM_TRAINED_TEMPLATES:])


def draw_template(spec: EpisodeSpec, templates: Sequence[str]) -> str:
    """Draw one of the templates of the spec's split."""
    of_spec = templates_of(spec.split, templates)
    return of_spec[generator(spec.seed, Stream.TEMPLATE).integers(len(of_spec))]


def refuse_options(spec: EpisodeSpec, *names: str) -> None:
    """Raise a ValueError if the spec sets an option that its suite draws or does not have."""
    for name in names:
        if (value := getattr(spec, name)) is not None:
            raise ValueError(f"--env.{name}={value} is not an option of --env.task={spec.suite}; drop it")


def specs_of_tasks(spec: EpisodeSpec, task_ids: Sequence[int]) -> list[EpisodeSpec]:
    """Return the spec for each of these numbered tasks of its suite; without numbers, the spec itself.

    Raises:
        ValueError: the suite lacks a task, a task is given twice, or the spec fixes what a task fixes.
    """
    suite = find_suite(spec.suite)
    if len(set(task_ids)) < len(task_ids):
        raise ValueError(f"--env.task_ids={list(task_ids)} has a task twice")
    for task_id in task_ids:
        if not 0 <= task_id < suite.num_tasks:
            raise ValueError(
                f"--env.task_ids has {task_id}; {spec.suite!r} has tasks 0..{suite.num_tasks - 1}"
            )
    return [suite.of_task(spec, task_id) for task_id in task_ids] or [spec]
