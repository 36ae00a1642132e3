"""Goals of LIBERO's tasks: predicates, and the order in which the scripted expert reaches them."""

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from lerobot_bomb.libero.assets import prepare_libero
from lerobot_bomb.libero.episode import LiberoSpec

# it opens before it puts, and closes at last
ORDER = ("open", "turnoff", "turnon", "in", "on", "close")
GOAL = re.compile(r"\(:goal\s*(.*)", re.DOTALL)
PREDICATE = re.compile(r"\(\s*([^\s()]+)((?:\s+[^\s()]+)+)\s*\)")


def check_goals(specs: Iterable[LiberoSpec]) -> None:
    """Check that the expert knows what the tasks of these specs ask for.

    Raises:
        ValueError: LIBERO or its assets are missing, or a task's file names another predicate.
    """
    specs = sorted(specs, key=lambda spec: (spec.suite, spec.task_id))
    folder = prepare_libero({spec.suite for spec in specs}).task_folders()["bddl_files"]
    from libero.libero import benchmark  # slow, and asks a question where prepare_libero has written no file

    for spec in specs:
        task = benchmark.get_benchmark_dict()[spec.suite]().get_task(spec.task_id)
        check_predicates(folder / task.problem_folder / task.bddl_file)


def check_predicates(path: Path) -> None:
    """Raise a ValueError if a task's file asks for a predicate that the expert does not know."""
    goal = GOAL.search(path.read_text())
    found = {name.lower() for name, _ in PREDICATE.findall(goal[1] if goal else "")}
    unknown = sorted(found - set(ORDER))
    if unknown:
        raise ValueError(
            f"{path}: the expert does not know the predicate {', '.join(unknown)}, only {', '.join(ORDER)}"
        )


def expert_order(goals: Sequence[Sequence[str]]) -> list[Sequence[str]]:
    """Return goals in the order in which the expert reaches them."""
    return sorted(goals, key=lambda goal: ORDER.index(goal[0]))
