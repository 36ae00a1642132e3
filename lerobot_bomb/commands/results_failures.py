"""List of failed episodes, each with the command that replays it."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from lerobot_bomb.commands.next_steps import print_next
from lerobot_bomb.environments import env_type
from lerobot_bomb.report.report import Sample
from lerobot_bomb.results.bomb import put_down
from lerobot_bomb.results.groups import Group, by_condition, suite_of
from lerobot_bomb.results.record import Record
from lerobot_bomb.tables import print_table, shorten

type Files = Mapping[Path, tuple[Mapping[int, Record], list[Group]]]  # {path: ({line: record}, groups)}


@dataclass(frozen=True)
class _Failure:
    group: Group
    sample: Sample

    @property
    def record(self) -> Record:
        return self.sample.record

    @property
    def error(self) -> str:
        """Distance of a stone that was put down from its target; '' of other episodes."""
        return "".join(f"{each.placement_error_mm:.1f} mm" for each in put_down([self.record]))

    @property
    def replay(self) -> str:
        """Command that replays the episode; '' for environments that have no view."""
        return self.sample.command if env_type(self.record.env_type).view_at else ""

    def cells(self) -> dict[str, str]:
        """Return {column: text}."""
        spec = self.record.spec
        return {
            "line": str(self.sample.line),
            "seed": str(spec.seed),
            "policy": shorten(self.group.policy),
            "suite": suite_of(self.group),
            "condition": spec.perturbations,
            "failure": str(self.record.failure),
            "error": self.error,
            "replay": self.replay,
        }


def print_failures(files: Files) -> None:
    """Print a line for each failed episode, by policy, condition, class and seed."""
    groups = [group for _, of_file in files.values() for group in of_file]
    failures = [
        failure
        for path, (numbered, of_file) in files.items()
        for group in of_file
        for failure in _failures(path, numbered, group)
    ]
    if not failures:
        number = sum(len(group.records) for group in groups)
        print(f"no failure in {number} episode{'s' * (number != 1)}")
        return
    rows = [each.cells() for each in failures]
    is_same = {
        "policy": len({group.policy for group in groups}) == 1,
        "suite": len({suite_of(group) for group in groups}) == 1,
        **{name: not any(row[name] for row in rows) for name in ("error", "replay")},
    }
    header = [name for name in rows[0] if not is_same.get(name)]
    words = ("policy", "suite", "condition", "failure", "replay")
    print_table(header, [[row[name] for name in header] for row in rows], left=words)
    if explanation := failures[0].sample.explanation:
        print_next({explanation: "what the actions of the first depend on"})


def _failures(path: Path, numbered: Mapping[int, Record], group: Group) -> Iterator[_Failure]:
    """Yield the failures of a group of a file's records, sorted."""
    lines = {id(record): line for line, record in numbered.items()}
    for records in by_condition(group.records).values():
        failed = [each for each in records if not each.is_success]
        failed.sort(key=lambda each: (each.failure, each.spec.seed, lines[id(each)]))
        for record in failed:
            yield _Failure(group, Sample(group.name, record, path, lines[id(record)]))
