"""Parts of the speed benchmarks: an idle machine, and tables that are also JSON."""

import argparse
import json
import os
import platform
from pathlib import Path
from typing import Any

MAX_LOAD_PER_CORE = 0.5  # one-minute load average


def add_machine_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare --json and --force."""
    parser.add_argument("--json", type=writable, help="also write the figures to this file")
    parser.add_argument("--force", action="store_true", help="measure on a busy machine all the same")


def positive(text: str) -> int:
    """A whole number from 1 on."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} must be a whole number from 1 on")
    return int(text)


def writable(text: str) -> Path:
    """A file in a folder that exists."""
    path = Path(text)
    if path.is_dir() or not os.access(path.parent, os.W_OK):
        raise argparse.ArgumentTypeError(f"{text!r} cannot be written")
    return path


def require_idle_machine(force: bool) -> None:
    """Print the load average; leave with exit code 1 when other work would spoil the figures."""
    num_cores = os.cpu_count() or 1
    load = os.getloadavg()[0]
    print(f"{platform.processor() or platform.machine()}, {num_cores} cores, load average {load:.2f}")
    if load > MAX_LOAD_PER_CORE * num_cores and not force:
        raise SystemExit(
            f"The load is above {MAX_LOAD_PER_CORE} per core: wait until the machine is idle, or use --force."
        )


def require_cuda(instead: str) -> None:
    """Leave with exit code 1, and what to do instead, where no CUDA device is."""
    import torch

    if not torch.cuda.is_available():
        raise SystemExit(f"No CUDA device is there; {instead}")


def write_figures(path: Path | None, figures: dict[str, Any]) -> None:
    """Write the figures of a run, with the load under which it ended, as JSON."""
    if path is not None:
        path.write_text(json.dumps({**figures, "load_average": os.getloadavg()[0]}, indent=1) + "\n")
