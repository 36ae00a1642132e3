"""Reads the episode results that ``--env.results_path`` collects and summarises them."""

import argparse
import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from lerobot_bomb.flags import path_flag
from lerobot_bomb.perturbations import NONE
from lerobot_bomb.schema import PROTOCOL_VERSION, Failure
from lerobot_bomb.stats import format_rate, mcnemar_p_value

# outcomes of an episode in which the stone was carried and put down somewhere on the board
PUT_DOWN = (None, Failure.WRONG_INTERSECTION, Failure.IMPRECISE, Failure.DISTURBED_OTHERS)

# what differs between episodes of one condition
DRAWN = ("seed", "target", "color")

Row = dict[str, Any]  # the fields of EpisodeResult


@dataclass(frozen=True)
class Summary:
    """What a results file says: counts over its episodes and errors of the stones that were released."""

    num_episodes: int
    num_successes: int
    median_error_mm: float | None  # over the episodes in which the stone was put down on the board
    failures: Counter[str]

    def lines(self) -> list[str]:
        """The summary as text, a line each."""
        error = "-" if self.median_error_mm is None else f"{self.median_error_mm:.1f} mm"
        failures = ", ".join(f"{name} {count}" for name, count in self.failures.most_common()) or "none"
        return [
            f"success          {format_rate(self.num_successes, self.num_episodes)} (95 % Wilson interval)",
            f"placement error  {error} (median of the stones that were put down)",
            f"failures         {failures}",
        ]


def read_results(path: Path) -> list[Row]:
    """The rows of a JSON-lines results file; of an episode that was run again, the last one.

    Raises:
        ValueError: the file is missing, empty, not JSON lines, or of another protocol version.
    """
    if not path.is_file():
        raise ValueError(
            f"{path}: no such results file; lerobot-eval writes it with --env.results_path={path}"
        )
    rows: dict[str, Row] = {}
    for number, line in enumerate(path.read_text().splitlines(), start=1):
        try:
            row = json.loads(line)
            version = row["protocol_version"]
            rows[json.dumps(row["spec"])] = row
        except (json.JSONDecodeError, KeyError, TypeError) as error:
            raise ValueError(f"{path}:{number}: not an episode result ({error!r})") from error
        if version != PROTOCOL_VERSION:
            raise ValueError(
                f"{path}:{number}: protocol_version {version!r}, this package has {PROTOCOL_VERSION!r}; "
                "results of different versions do not compare"
            )
    if not rows:
        raise ValueError(f"{path}: no finished episode")
    return list(rows.values())


def common_settings(rows: list[Row]) -> str:
    """What the spec of every row says, and the range of seeds."""
    first = rows[0]["spec"]
    common = [
        f"{name}={value}"
        for name, value in first.items()
        if name not in DRAWN and all(row["spec"].get(name) == value for row in rows)
    ]
    seeds = [row["spec"]["seed"] for row in rows]
    return f"protocol {PROTOCOL_VERSION}, {', '.join(common)}, seeds {min(seeds)}..{max(seeds)}"


def by_condition(rows: list[Row]) -> dict[str, list[Row]]:
    """Rows apart that do not compare: {"" or " (what differs)": rows}."""
    specs = [{name: row["spec"][name] for name in row["spec"] if name not in DRAWN} for row in rows]
    differing = [name for name in specs[0] if any(spec.get(name) != specs[0][name] for spec in specs)]
    conditions: dict[str, list[Row]] = {}
    for row, spec in zip(rows, specs, strict=True):
        label = ", ".join(f"{name}={spec.get(name)}" for name in differing)
        conditions.setdefault(f" ({label})" if label else "", []).append(row)
    return conditions


def summarise(rows: list[Row]) -> Summary:
    """Counts, rates and the median error of episodes."""
    errors = [row["placement_error_mm"] for row in rows if row["failure"] in PUT_DOWN]
    return Summary(
        num_episodes=len(rows),
        num_successes=sum(row["is_success"] for row in rows),
        median_error_mm=median(errors) if errors else None,
        failures=Counter(row["failure"] for row in rows if not row["is_success"]),
    )


def pair_with_nominal(rows: list[Row]) -> dict[str, list[tuple[Row, Row]]]:
    """{condition: (unperturbed, perturbed) rows of the same episode}, for the conditions that have both."""
    nominal = {_episode(row): row for row in rows if row["spec"]["perturbations"] == NONE}
    pairs: dict[str, list[tuple[Row, Row]]] = {}
    for row in rows:
        condition = row["spec"]["perturbations"]
        if condition != NONE and _episode(row) in nominal:
            pairs.setdefault(condition, []).append((nominal[_episode(row)], row))
    return pairs


def _episode(row: Row) -> str:
    """What a row's spec is but for its perturbations."""
    return json.dumps({name: value for name, value in row["spec"].items() if name != "perturbations"})


def _pair_line(condition: str, pairs: list[tuple[Row, Row]]) -> str:
    lost = sum(nominal["is_success"] and not row["is_success"] for nominal, row in pairs)
    won = sum(row["is_success"] and not nominal["is_success"] for nominal, row in pairs)
    p_value = mcnemar_p_value(lost, won)
    return (
        f"  {condition}: {len(pairs)} pairs, {lost} lost, {won} won, p = {p_value:.2g} (exact McNemar test)"
    )


def add_results_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``lerobot-bomb results``."""
    parser.add_argument(
        "paths", nargs="+", type=path_flag, metavar="FILE", help="files of --env.results_path"
    )


def run_results(args: argparse.Namespace) -> int:
    """Print a summary of each condition of each file, and what perturbations changed in paired episodes."""
    for path in args.paths:
        all_rows = read_results(path)
        print(f"{path}: {common_settings(all_rows)}")
        num_replaced = sum(map(bool, path.read_text().splitlines())) - len(all_rows)
        if num_replaced:
            print(f"{path}: {num_replaced} lines count no more, a later one is of the same episode")
        for condition, rows in by_condition(all_rows).items():
            summary = summarise(rows)
            print(f"{path}{condition}: {summary.num_episodes} episodes")
            for line in summary.lines():
                print(f"  {line}")
        pairs = pair_with_nominal(all_rows)
        if pairs:
            print(f"{path}: against the same episodes unperturbed")
        elif any(row["spec"]["perturbations"] != NONE for row in all_rows):
            print(f'{path}: no unperturbed episodes to compare with; add "none" to --env.perturbations')
        for condition, of in pairs.items():
            print(_pair_line(condition, of))
    return 0
