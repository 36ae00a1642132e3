"""``lerobot-bomb compare``: two policies on the same episodes."""

import argparse
from collections.abc import Sequence

from lerobot_bomb.commands.arguments import ANSWER_IS_NO, add_names_flag, parse_conditions, path_flag
from lerobot_bomb.commands.results_files import check_outputs, names_of, policy_keys, read_undamaged
from lerobot_bomb.files import written_whole
from lerobot_bomb.flags import one_of
from lerobot_bomb.report.latex import comparison_table
from lerobot_bomb.results.comparison import compare
from lerobot_bomb.results.groups import settings_of
from lerobot_bomb.results.names import policy_key
from lerobot_bomb.results.record import Record
from lerobot_bomb.tables import print_lines


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    two = "without B: two of A's policies (default: the two that it has)"
    add("a", type=path_flag, metavar="A", help="file of --env.results_path")
    add("b", type=path_flag, metavar="B", nargs="?", help="results file of another policy, on the same seeds")
    output = "also write the comparison as a LaTeX table to this file, .tex"
    add("--output", type=path_flag, metavar="FILE.tex", help=output)
    add_names_flag(parser)
    add("--across", metavar="FIELD", help="compare one policy of A across: simulator, render_preset")
    add("--policies", type=parse_conditions, default=(), metavar="A,B", help=two)
    unless = (
        f"exit code {ANSWER_IS_NO} unless, under every condition and with 95 %% confidence, B's success is"
    )
    add("--min_difference", type=_points, metavar="POINTS", help=f"{unless} higher by POINTS of 100 or more")
    add("--non_inferior", type=_points, metavar="POINTS", help=f"{unless} lower by less than POINTS")


def _points(text: str) -> float:
    try:
        points = float(text)
    except ValueError:
        points = -1.0
    if not 0 <= points <= 100:
        raise argparse.ArgumentTypeError(f"{text!r} must be points of a success rate, 0..100")
    return points


def _two_policies(args: argparse.Namespace) -> tuple[list[Record], list[Record]]:
    """Return the records of the two policies, from two files or from one."""
    if args.b is not None:
        if args.policies:
            raise ValueError("--policies chooses two of one file; give one, or drop it")
        first, second = (read_undamaged(path).records for path in (args.a, args.b))
        return first, second
    both = _by_policy(read_undamaged(args.a).records, args.policies)
    if len(both) != 2:
        names = "; ".join(records[0].describe_policy() for records in both)
        is_alone = len(both) == 1 and not args.policies
        remedy = "name the file of a second one" if is_alone else "choose two with --policies=A,B"
        raise ValueError(f"{args.a}: two policies are compared, not {len(both)} ({names}); {remedy}")
    return both[0], both[1]


def _two_values(args: argparse.Namespace) -> tuple[list[Record], list[Record]]:
    """Return the records of A with either value of the setting --across."""
    if args.b is not None:
        raise ValueError("--across compares records of one file; leave B out")
    records = [each for part in _by_policy(read_undamaged(args.a).records, args.policies) for each in part]
    one_of("--across", args.across, tuple({name: None for each in records for name in each.comparable}))
    by_value: dict[str, list[Record]] = {}
    for record in records:
        by_value.setdefault(settings_of(record)[args.across], []).append(record)
    if len(by_value) != 2:
        raise ValueError(
            f"{args.a}: --across={args.across} compares two of its values, not {len(by_value)} "
            f"({', '.join(by_value)}); evaluate with another --env.{args.across}, into the same file"
        )
    first, second = by_value.values()
    return first, second


def _by_policy(records: list[Record], names: Sequence[str]) -> list[list[Record]]:
    """Split records by policy: those that are named, or all in order of first appearance."""
    by_key: dict[str, list[Record]] = {}
    for record in records:
        by_key.setdefault(policy_key(record.policy), []).append(record)
    return [by_key[key] for key in (policy_keys("--policies", names, records) if names else by_key)]


def _write(args: argparse.Namespace, text: str) -> None:
    check_outputs([path for path in (args.a, args.b) if path is not None], [args.output])
    with written_whole(args.output) as (unfinished,):
        unfinished.write_text(text)
    print(args.output)


def run(args: argparse.Namespace) -> int:
    """Print both rates and their difference, by condition; check the required difference."""
    if args.output is not None and args.output.suffix != ".tex":
        raise ValueError(f"--output={args.output} must be a file of LaTeX, .tex")
    sides = _two_policies(args) if args.across is None else _two_values(args)
    names = names_of(args.names, [*sides[0], *sides[1]])
    comparisons = compare(*sides, names, args.across)
    print_lines(*comparisons.lines())
    if args.output is not None:
        _write(args, comparison_table(comparisons))
    low, how = comparisons.lowest
    verdicts = []
    if (bar := args.min_difference) is not None:
        verdicts.append((f"--min_difference={bar:g}: B is better by {bar:g} points or more", low >= bar))
    if (bar := args.non_inferior) is not None:
        verdicts.append((f"--non_inferior={bar:g}: B is worse by less than {bar:g} points", low > -bar))
    for claim, is_shown in verdicts:
        print(f"{claim}: {'shown' if is_shown else 'not shown'} ({how})")
    return 0 if all(is_shown for _, is_shown in verdicts) else ANSWER_IS_NO
