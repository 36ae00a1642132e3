"""Shares of a machine that each of several workers gets: threads, and one of its GPUs."""

import os
from collections.abc import Mapping, Sequence
from itertools import takewhile
from pathlib import Path

GPUS = "CUDA_VISIBLE_DEVICES"
DRIVER = Path("/proc/driver/nvidia/gpus")  # has a folder for each GPU


def num_cores() -> int:
    """Count the cores that this process may use: a cluster gives a job some of a machine's."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def visible_gpus(environment: Mapping[str, str], driver: Path = DRIVER) -> list[str]:
    """Return GPUs as CUDA_VISIBLE_DEVICES names them; if it is not set, all that the driver lists."""
    if GPUS in environment:
        # CUDA sees none from the first -1 on
        return list(takewhile(lambda gpu: gpu != "-1", filter(None, environment[GPUS].split(","))))
    return [str(number) for number, _ in enumerate(driver.iterdir())] if driver.is_dir() else []


def worker_environments(
    num_workers: int, environment: Mapping[str, str], cores: int, gpus: Sequence[str]
) -> list[dict[str, str]]:
    """Return one per worker: an even share of the cores as threads, unless set, and a GPU in turn."""
    threads = {"OMP_NUM_THREADS": str(max(1, cores // num_workers))}
    return [
        threads | dict(environment) | ({GPUS: gpus[worker % len(gpus)]} if gpus else {})
        for worker in range(num_workers)
    ]
