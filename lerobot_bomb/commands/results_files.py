"""Files of results that a command is given."""

import sys
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot_bomb.bomb.environment import numbered_task
from lerobot_bomb.checkpoints.shipped import checkpoint_path
from lerobot_bomb.results.groups import PER_TASK, Group, groups_of, settings_of, suite_or_task
from lerobot_bomb.results.names import policy_key, policy_names
from lerobot_bomb.results.reading import check_any, read_records
from lerobot_bomb.results.record import Record, Spec, describe_numbers
from lerobot_bomb.sweep.manifest import NAME, Manifest
from lerobot_bomb.sweep.store import ERRORS, RESULTS, num_lost, read_errors
from lerobot_bomb.tables import in_a_row

MAX_SHOWN_DAMAGES = 10


def check_outputs(inputs: Sequence[Path], outputs: Iterable[Path]) -> None:
    """Raise a ValueError if an output file is also an input file."""
    read = {path.resolve() for path in inputs}
    for path in outputs:
        if path.resolve() in read:
            raise ValueError(f"--output: {path} is a file of results that is read; name another output")


def missing_of_sweep(path: Path, num_records: int) -> str:
    """Say how many episodes a sweep's file lacks, and why; "" if none, or if it is another file."""
    if path.name != RESULTS or not path.with_name(NAME).is_file():
        return ""
    errors = path.with_name(ERRORS)
    try:
        manifest = Manifest.read(path.parent)
        ended = num_lost(manifest, read_errors(errors))
    except (ValueError, TypeError) as error:  # the episodes can be read all the same
        return f"{path}: whether episodes are missing cannot be said: {error}"
    number, sweep = manifest.num_records, f"lerobot-bomb sweep {path.parent}"
    missing = number - num_records
    reasons = [f"an error ended {ended}: {errors}, `{sweep} --retry` runs them again"] if ended else []
    reasons += [f"`{sweep}` resumes"] if missing > ended else []
    return f"{path}: {missing} of {number} episodes are missing; {'; '.join(reasons)}" if missing > 0 else ""


def missing_of_evaluations(path: Path, records: Sequence[Record]) -> str:
    """Say how many episodes of its evaluations a file has; "" if all, or if its records do not tell.

    An evaluation no longer counts once later ones have run each of its episodes again.
    """
    kept = {id(each) for group in groups_of(records) for each in group.records}
    current: set[tuple[Any, ...]] = set()  # parts with a record that later ones have not replaced
    played: dict[Any, dict[Any, Counter[Spec]]] = {}  # {evaluation: {part: times that episodes were run}}
    for record in records:
        if record.evaluation is not None:
            key, part = _evaluation_of(record), _part_of(record)
            played.setdefault(key, {}).setdefault(part, Counter())[record.spec] += 1
            if id(record) in kept:
                current.add((key, part))
    counts = []
    for key, parts in played.items():
        num_episodes = key[0].num_episodes
        stopped = _stopped_parts(parts, num_episodes)
        if any((key, part) in current for part in stopped):
            numbers = [len(parts[part]) for part in stopped]
            numbers = [sum(numbers)] if sum(numbers) < num_episodes else numbers
            counts += [f"{number} of {num_episodes}" for number in numbers]
    if not counts:
        return ""
    return f"{path}: {' and '.join(counts)} episodes played; lerobot-eval was stopped, or still runs"


def _stopped_parts(parts: Mapping[Any, Counter[Spec]], num_episodes: int) -> list[Any]:
    """Return the parts that lack episodes, of evaluations with the same number of episodes and first seed.

    All parts of an evaluation have equally many episodes: with n in each, it has num_episodes / n parts.
    """
    times_run = Counter(
        sum(times >= repetition for times in part.values())
        for part in parts.values()
        for repetition in range(1, max(part.values()) + 1)
    )
    stopped = []
    for number, times in times_run.items():
        if number < num_episodes:
            is_share = num_episodes % number == 0
            num_whole = times - times % (num_episodes // number) if is_share else 0
            stopped += [name for name, part in parts.items() if len(part) == number][num_whole:]
    return stopped


def _part_of(record: Record) -> tuple[Any, ...]:
    """Return a key of a record's suite, condition and numbered task, which LeRobot evaluates one by one."""
    return suite_or_task(record), record.spec.perturbations, numbered_task(vars(record.spec))


def _evaluation_of(record: Record) -> tuple[Any, ...]:
    """Return a key that is equal for the records of one evaluation; its first part is the evaluation."""
    return record.evaluation, *(pair for pair in settings_of(record).items() if pair[0] not in PER_TASK)


@dataclass(frozen=True)
class ResultsFile:
    """A results file as it was read, without the damaged records."""

    path: Path
    numbered: dict[int, Record]  # by line, from 1
    num_damaged: int
    missing: str  # the episodes of its sweep or evaluation that it lacks; "": none

    @property
    def records(self) -> list[Record]:
        return [*self.numbered.values()]


@dataclass(frozen=True)
class FileGroups:
    """A results file, and the groups of its records."""

    file: ResultsFile
    groups: list[Group]


def read_record(path: Path, line: int) -> Record:
    """Return the record on a line of a file, counted from 1.

    Raises:
        ValueError: there is no record on that line; or see `read_undamaged`.
    """
    numbered = read_undamaged(path).numbered
    if line not in numbered:
        raise ValueError(
            f"--line={line} is no episode of {path}, whose lines are {describe_numbers(numbered)}"
        )
    return numbered[line]


def read_undamaged(path: Path) -> ResultsFile:
    """Read the records of a file; print its first damaged records and missing episodes to stderr.

    Raises:
        ValueError: there is no such file, or no record in it.
    """
    numbered, damages = read_records(path)
    for damage in damages[: MAX_SHOWN_DAMAGES if numbered else 1]:  # of another file, one line says enough
        print(f"{damage}; not counted", file=sys.stderr)
    check_any(path, numbered, damages)
    if len(damages) > MAX_SHOWN_DAMAGES:
        print(f"{path}: ... and {len(damages) - MAX_SHOWN_DAMAGES} more such lines", file=sys.stderr)
    records = [*numbered.values()]
    missing = missing_of_sweep(path, len(records)) or missing_of_evaluations(path, records)
    if missing:
        print(missing, file=sys.stderr)
    return ResultsFile(path, numbered, len(damages), missing)


def read_together(paths: Iterable[Path]) -> list[ResultsFile]:
    """Read files whose records are pooled, each once, as `read_undamaged`.

    Raises:
        ValueError: the policies of several files are not recorded, so nothing tells them apart; or see
            `read_undamaged`.
    """
    files = [read_undamaged(path) for path in dict.fromkeys(paths)]
    unknown = [str(file.path) for file in files if any(each.policy is None for each in file.records)]
    if len(unknown) > 1:
        raise ValueError(
            f"the records of {in_a_row(unknown)} name no policy, so nothing tells if it is one: give one "
            "of these files, or join those of one policy"
        )
    return files


def tell_replaced(groups: Iterable[Group]) -> list[str]:
    """Print to stderr how many records of each group are replaced by later ones; return these lines."""
    lines = [f"{group.name}: {group.replaced}" for group in groups if group.replaced]
    for line in lines:
        print(line, file=sys.stderr)
    return lines


def policy_keys(flag: str, names: Sequence[str], records: Sequence[Record]) -> list[str]:
    """Return the key of each named policy.

    A name is the one in `results`, a policy's type, its path, `bomb:NAME`, or any part of its description.

    Raises:
        ValueError: a name fits no policy, or several.
    """
    first: dict[str, Record] = {}
    for record in records:
        first.setdefault(policy_key(record.policy), record)
    described = {key: record.describe_policy() for key, record in first.items()}
    short = dict(zip(first, policy_names([each.policy for each in first.values()]), strict=True))
    found = []
    for name in names:
        keys = (
            [key for key, text in short.items() if name == text]
            or [key for key, text in described.items() if name in text.split()]
            or [key for key, text in described.items() if checkpoint_path(name) in text]
        )
        if len(keys) != 1:
            texts = "; ".join(described.values())
            raise ValueError(f"{flag}: {name} must name one policy of the file, not {len(keys)}: {texts}")
        found.append(keys[0])
    return found


def names_of(names: Mapping[str, str], records: Sequence[Record]) -> dict[str, str]:
    """Return {key of a policy: its name} of the flag --names.

    Raises:
        ValueError: see `policy_keys`.
    """
    return dict(zip(policy_keys("--names", list(names), records), names.values(), strict=True))
