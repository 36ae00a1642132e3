"""List of failed episodes, each with the command that replays it."""

from collections.abc import Iterator, Sequence

from lerobot_bomb.commands.next_steps import print_next
from lerobot_bomb.commands.results_files import FileGroups, ResultsFile
from lerobot_bomb.environments import env_type
from lerobot_bomb.report.report import Sample
from lerobot_bomb.results.bomb import put_down
from lerobot_bomb.results.groups import Group, by_condition, suite_of
from lerobot_bomb.tables import print_table, shorten_all


def print_failures(files: Sequence[FileGroups]) -> None:
    """Print a line for each failed episode, by policy, condition, class and seed."""
    groups = [group for each in files for group in each.groups]
    failures = [
        (group, sample) for each in files for group in each.groups for sample in _failures(each.file, group)
    ]
    if not failures:
        number = sum(len(group.records) for group in groups)
        print(f"no failure in {number} episode{'s' * (number != 1)}")
        return
    names = shorten_all(group.policy for group in groups)
    rows = [_row(names[group.policy], group, sample) for group, sample in failures]
    is_same = {
        "policy": len({group.policy for group in groups}) == 1,
        "suite": len({suite_of(group) for group in groups}) == 1,
        **{name: not any(row[name] for row in rows) for name in ("error", "replay")},
    }
    header = [name for name in rows[0] if not is_same.get(name)]
    words = ("policy", "suite", "condition", "failure", "replay")
    print_table(header, [[row[name] for name in header] for row in rows], left=words)
    if explanation := failures[0][1].explanation:
        print_next({explanation: "what the actions of the first depend on"})


def _row(policy: str, group: Group, failure: Sample) -> dict[str, str]:
    """Return {column: text} of a failed episode."""
    record = failure.record
    return {
        "line": str(failure.line),
        "seed": str(record.spec.seed),
        "policy": policy,
        "suite": suite_of(group),
        "condition": record.spec.perturbations,
        "failure": str(record.failure),
        "error": "".join(f"{each.placement_error_mm:.1f} mm" for each in put_down([record])),
        "replay": failure.command if env_type(record.env_type).view_at else "",
    }


def _failures(file: ResultsFile, group: Group) -> Iterator[Sample]:
    """Yield the failures of a group of a file's records, sorted."""
    lines = {id(record): line for line, record in file.numbered.items()}
    for records in by_condition(group.records).values():
        failed = [each for each in records if not each.is_success]
        failed.sort(key=lambda each: (each.failure, each.spec.seed, lines[id(each)]))
        for record in failed:
            yield Sample(group.name, record, file.path, lines[id(record)])
