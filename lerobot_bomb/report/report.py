"""A report: groups of episodes, and a sample of their failures."""

import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from random import Random

from lerobot_bomb.report.panels import Panel, panels_of
from lerobot_bomb.results.comparison import Comparisons, compare
from lerobot_bomb.results.groups import Group, Policy, policies_of
from lerobot_bomb.results.record import Record


@dataclass(frozen=True)
class Sample:
    """A failed episode that the report shows."""

    group: str
    record: Record
    path: Path  # of its file
    line: int  # of the file, from 1 on
    video: str | None = None  # link from the page
    film: bytes | None = None  # JPEG of the episode's filmstrip
    note: str = ""  # why there is none, or what is to be known of it

    @property
    def command(self) -> str:
        """Command that runs the episode again."""
        return shlex.join(["lerobot-bomb", "replay", str(self.path), f"--line={self.line}"])

    @property
    def explanation(self) -> str:
        """Command that explains the episode; '' if no checkpoint acted."""
        if self.record.policy is None or not self.record.policy.path:
            return ""
        return shlex.join(["lerobot-bomb", "explain", f"--results={self.path}", f"--line={self.line}"])


@dataclass(frozen=True)
class Report:
    """Groups, samples and gaps that the sections are made from."""

    groups: list[Group]
    samples: list[Sample] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)  # what files lack, or have damaged

    @cached_property
    def panels(self) -> list[Panel]:
        """Groups side by side that compare with each other."""
        return panels_of(self.groups)

    @cached_property
    def policies(self) -> dict[str, Policy]:
        """Policies by name."""
        return {each.short_name: each for each in policies_of(self.groups)}

    def label(self, group: Group) -> str:
        """Return the group's name, without the suite if all are of the same."""
        return group.policy if len(self.panels) == 1 else group.name

    def compared(self, first: str, second: str) -> Comparisons | None:
        """Compare two policies by name; None if they have no episode in common."""
        pair = first, second
        if pair not in self._compared:
            try:
                found = compare(self.policies[first].records, self.policies[second].records)
            except ValueError:  # no episode in common
                found = None
            self._compared[pair] = found
        return self._compared[pair]

    @cached_property
    def _compared(self) -> dict[tuple[str, str], Comparisons | None]:
        return {}


def sample_failures(
    groups: list[Group], files: Mapping[Path, Mapping[int, Record]], num_of_class: int
) -> Iterator[Sample]:
    """Sample episodes of each group and class of failure; the same files give the same ones.

    `files`: {path: {line: record}}, from which the groups' records come.
    """
    places = {id(record): (path, line) for path, lines in files.items() for line, record in lines.items()}
    for group in groups:
        failed: dict[str, list[Record]] = {}
        for record in group.records:
            if record.failure is not None:
                failed.setdefault(record.failure, []).append(record)
        for records in sorted(failed.values(), key=len, reverse=True):
            for record in Random(0).sample(records, min(num_of_class, len(records))):
                yield Sample(group.name, record, *places[id(record)])
