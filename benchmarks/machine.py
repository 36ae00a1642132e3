"""Frame of the benchmarks: arguments, an idle machine, time, tables that are also JSON, and bars."""

import argparse
import json
import os
import platform
import re
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

MAX_LOAD_PER_CORE = 0.5  # one-minute load average

type Rows = dict[str, dict[str, float]]


def make_parser(doc: str | None) -> argparse.ArgumentParser:
    """Return a parser that shows a script's docstring as it is written."""
    return argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)


def add_json_argument(parser: argparse.ArgumentParser) -> None:
    """Declare --json."""
    parser.add_argument("--json", type=writable, help="also write the figures to this file")


def add_machine_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare --json and --force."""
    add_json_argument(parser)
    parser.add_argument("--force", action="store_true", help="measure on a busy machine all the same")


def parse_on_idle_machine(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """Parse the command line, with --json and --force; exit with code 1 if the machine is busy."""
    add_machine_arguments(parser)
    args = parser.parse_args()
    require_idle_machine(args.force)
    return args


def parse_with_policy_flags(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """Parse the command line like parse_on_idle_machine; args.policy_flags are for `lerobot-train`."""
    add_machine_arguments(parser)
    args, args.policy_flags = parser.parse_known_args()
    unknown = [flag for flag in args.policy_flags if not re.fullmatch(r"--policy\.\w+=.*", flag)]
    if unknown:
        parser.error(f"unknown: {' '.join(unknown)}; flags for lerobot-train are --policy.NAME=VALUE")
    require_idle_machine(args.force)
    return args


def positive(text: str) -> int:
    """Parse a whole number from 1 on."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} must be a whole number from 1 on")
    return int(text)


def writable(text: str) -> Path:
    """Parse the path of a file that can be written."""
    path = Path(text)
    if path.is_dir() or not os.access(path.parent, os.W_OK):
        raise argparse.ArgumentTypeError(f"{text!r} cannot be written")
    return path


def require_idle_machine(force: bool) -> None:
    """Print the load average; exit with code 1 if other work would spoil the figures."""
    num_cores = os.cpu_count() or 1
    load = os.getloadavg()[0]
    print(f"{platform.processor() or platform.machine()}, {num_cores} cores, load average {load:.2f}")
    if load > MAX_LOAD_PER_CORE * num_cores and not force:
        raise SystemExit(
            f"The load is above {MAX_LOAD_PER_CORE} per core: wait until the machine is idle, or use --force."
        )


def device_name(device: str) -> str:
    """Print and return the name of "cpu" or of the CUDA device; exit with code 1 if there is none."""
    import torch

    if device == "cuda" and not torch.cuda.is_available():
        raise SystemExit("No CUDA device is there; --device=cpu, or another benchmark, measures on a CPU.")
    name = torch.cuda.get_device_name() if device == "cuda" else device
    print(name, f"torch {torch.__version__}")
    return name


def milliseconds(call: Callable[[], object], clock: Callable[[], float] = time.perf_counter) -> float:
    """Return the milliseconds that a call takes."""
    start = clock()
    call()
    return 1e3 * (clock() - start)


def wait_and_time[T](call: Callable[[], T]) -> tuple[T, float]:
    """Return the call's result, and the seconds until the device, if there is one, has computed it."""
    import torch

    wait = torch.cuda.synchronize if torch.cuda.is_available() else lambda: None
    wait()
    started = time.perf_counter()
    result = call()
    wait()
    return result, time.perf_counter() - started


def print_rows(title: str, figures: Rows) -> None:
    """Print a table of rows of figures; one that a row lacks is a dash."""
    from lerobot_bomb.tables import print_table  # a peer's Python, which may run a script, lacks it

    header = list(dict.fromkeys(name for row in figures.values() for name in row))
    rows = [
        [name, *(f"{row[column]:.2f}" if column in row else "-" for column in header)]
        for name, row in figures.items()
    ]
    print()
    print_table([title, *(column.replace("_", " ") for column in header)], rows)


def write_figures(path: Path | None, figures: dict[str, Any]) -> None:
    """Write the figures of a run, with the load under which it ended, as JSON."""
    if path is not None:
        path.write_text(json.dumps({**figures, "load_average": os.getloadavg()[0]}, indent=1) + "\n")


def finish(path: Path | None, figures: dict[str, Any], bars: dict[str, bool]) -> None:
    """Print which bars hold, write the figures and exit, with code 1 if a bar is missed."""
    print("", *(f"{'ok' if holds else 'MISSED'}: {bar}" for bar, holds in bars.items()), sep="\n")
    write_figures(path, {**figures, "bars": bars})
    sys.exit(0 if all(bars.values()) else 1)
