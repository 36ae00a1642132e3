"""``lerobot-bomb results``: the files of ``--env.results_path`` as one table, or their failures."""

import argparse
import shlex
from collections.abc import Iterable, Iterator, Mapping
from itertools import combinations

from lerobot_bomb.commands.arguments import path_flag
from lerobot_bomb.commands.next_steps import print_next
from lerobot_bomb.commands.results_failures import print_failures
from lerobot_bomb.commands.results_files import FileGroups, ResultsFile, read_undamaged
from lerobot_bomb.commands.table import PROGRAM
from lerobot_bomb.report.panels import Series, series_of
from lerobot_bomb.results.comparison import have_pairs
from lerobot_bomb.results.groups import (
    POLICY,
    Group,
    by_condition,
    differing,
    differing_otherwise,
    groups_of,
    suite_of,
)
from lerobot_bomb.results.summary import describe_unpaired, pair_lines, summarise
from lerobot_bomb.stats import format_p
from lerobot_bomb.tables import print_lines, print_table, shorten_all

LEGEND = (
    "success: with 95 % Wilson interval; change: points, with 95 % interval, from the same episodes",
    "unperturbed; p: exact McNemar test; where interval and p disagree, trust p; with several tasks of one",
    "seed, trust the interval, which counts a seed once",
)
WORDS = ("policy", "suite", "condition")  # columns at the left


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    add("paths", nargs="+", type=path_flag, metavar="FILE", help="files of --env.results_path")
    add("--strict", action="store_true", help="refuse files with damaged records")
    shown = parser.add_mutually_exclusive_group()
    shown.add_argument(
        "--failures", action="store_true", help="list the failed episodes, each with its replay command"
    )
    verbose = "also print what was run, measures, failure classes, latency and smoothness of every condition"
    shown.add_argument("--verbose", action="store_true", help=verbose)


def run(args: argparse.Namespace) -> int:
    """Print rates by condition and the paired changes under perturbations, or the failures."""
    files = [read_undamaged(path) for path in dict.fromkeys(args.paths)]
    for file in files:
        if args.strict and file.num_damaged:
            raise ValueError(f"{file.path}: damaged records, which --strict refuses: {file.num_damaged}")
    names = _policy_names(files) if len(files) > 1 else {}
    told = [FileGroups(file, groups_of(file.records, names)) for file in files]
    if args.failures:
        print_failures(told)
        return 0
    series = _series_by_file(told)
    _print_rates(told, series)
    print()
    print_lines(*LEGEND, *_notes(told))
    if args.verbose:
        for each, of_file in zip(told, series, strict=True):
            print()
            _print_details(each, of_file)
    print_next(_next_steps(told))
    return 0


def _policy_names(files: Iterable[ResultsFile]) -> dict[str, str]:
    """Return {key of a policy: its name among those of all files}."""
    records = [record for file in files for record in file.records]
    return {group.settings[POLICY]: group.policy for group in groups_of(records)}


def _series_by_file(told: list[FileGroups]) -> list[list[Series]]:
    """Return the series of each file; the p-values of a policy are adjusted over all files."""
    found = iter(series_of([group for each in told for group in each.groups]))
    return [[next(found) for _ in each.groups] for each in told]


def _print_rates(told: list[FileGroups], by_file: list[list[Series]]) -> None:
    """Print a line for each group and condition."""
    several = len(told) > 1
    apart = [*{name: None for each in told for name in differing_otherwise(each.groups)}]
    names = shorten_all(group.policy for each in told for group in each.groups)
    rows = [
        [
            *([str(each.file.path)] if several else []),
            *(names[series.policy], suite_of(series.group)),
            *(_setting(series.group, name) for name in apart),
            *cells,
        ]
        for each, of_file in zip(told, by_file, strict=True)
        for series in of_file
        for cells in _cells(series)
    ]
    header = [*(["file"] if several else []), "policy", "suite", *apart, "condition"]
    print_table([*header, "success", "change", "p (Holm)", "n"], rows, left=(*WORDS, *apart))


def _cells(series: Series) -> Iterator[list[str]]:
    """Yield condition, rate, change, p and number of episodes."""
    for condition, rate in series.rates.items():
        change = series.costs.get(condition)
        changed = ["", ""] if change is None else [change.describe_difference(), _p(change.p_value)]
        yield [condition, rate.percent, *changed, str(rate.n)]


def _p(p_value: float) -> str:
    """Return '0.031', or '< 1e-99'."""
    return format_p(p_value).removeprefix("p ").removeprefix("= ")


def _setting(group: Group, name: str) -> str:
    if name == "tasks":
        return group.record_type.describe_tasks(group.records)
    return group.settings.get(name, "")


def _notes(told: list[FileGroups]) -> Iterator[str]:
    """Yield what is damaged, not compared, or kept apart."""
    names = shorten_all(group.name for each in told for group in each.groups)
    for each in told:
        path = each.file.path
        if each.file.num_damaged:
            yield f"{path}: damaged records, which are not counted: {each.file.num_damaged}"
        if apart := differing_otherwise(each.groups):
            yield f"{path}: episodes that differ in {', '.join(apart)} are neither pooled nor paired"
        for group in each.groups:
            if unpaired := describe_unpaired(group, each.groups):
                yield f"{path}: {names[group.name]}: {unpaired}"


def _print_details(told: FileGroups, series: list[Series]) -> None:
    """Print each group's heading, and the measures under each condition."""
    path = told.file.path
    if len(told.groups) > 1:
        print(
            f"{path}: {len(told.groups)} groups of episodes, neither pooled nor paired with each other; they "
            f"differ in {', '.join(differing(told.groups))}"
        )
    for group, of_group in zip(told.groups, series, strict=True):
        print_lines(*(f"{path}: {line}" for line in group.lines()))
        if group.missing_fields:
            version = group.records[0].protocol_version
            lacking = ", ".join(group.missing_fields)
            print(f"{path}: records of protocol {version} lack {lacking}")
        if group.replaced:
            print(f"{path}: {group.replaced}")
        conditions = by_condition(group.records)
        for condition, records in conditions.items():
            label = f" (perturbations={condition})" if len(conditions) > 1 else ""
            print(f"{path}{label}: {len(records)} episode{'s' * (len(records) != 1)}")
            print_lines(*(f"  {line}" for line in summarise(records).lines()))
        if against := pair_lines([*of_group.costs.values()]):
            print(f"{path}: against the same episodes unperturbed", *against, sep="\n")


def _are_two_to_compare(told: list[FileGroups]) -> bool:
    """Return True for two policies with episodes in common, in one file or in a file each."""
    policies = [{group.settings[POLICY] for group in each.groups} for each in told]
    if len(set().union(*policies)) != 2 or [len(each) for each in policies] not in ([2], [1, 1]):
        return False
    groups = [group for each in told for group in each.groups]
    return any(a.policy != b.policy and have_pairs(a, b) for a, b in combinations(groups, 2))


def _next_steps(told: list[FileGroups]) -> Mapping[str, str]:
    paths = shlex.join(str(each.file.path) for each in told)
    groups = [group for each in told for group in each.groups]
    steps: dict[str, str] = {}
    if number := sum(not record.is_success for group in groups for record in group.records):
        purpose = f"{number} failure{'s' * (number > 1)}, each with the command that replays it"
        steps[f"{PROGRAM} results {paths} --failures"] = purpose
    if _are_two_to_compare(told):
        steps[f"{PROGRAM} compare {paths}"] = "both policies on the same episodes"
    steps[f"{PROGRAM} report {paths}"] = "figures, failures and settings as one page"
    return steps
