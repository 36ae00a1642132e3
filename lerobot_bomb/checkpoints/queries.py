"""Timing of the queries of this process' policy, whatever its type."""

import re
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from time import perf_counter
from typing import Any
from weakref import WeakKeyDictionary

import torch
from lerobot.policies import PreTrainedPolicy
from torch import Tensor

from lerobot_bomb.compat.hooks.policies import wrap_select_action
from lerobot_bomb.results.inference import Query

PROCESS = Path("/proc/self")  # of Linux
RESET_PEAK = "5"  # in clear_refs: count a process' peak memory anew

_CLOCKS: "WeakKeyDictionary[PreTrainedPolicy, _Clock]" = WeakKeyDictionary()


def time_queries(policy: PreTrainedPolicy) -> None:
    """Time the policy's queries for `last_query`, unless it has no network."""
    if policy in _CLOCKS or next(policy.parameters(), None) is None:
        return
    _CLOCKS[policy] = _Clock(policy)
    wrap_select_action(policy, _timed)


def last_query() -> Query | None:
    """Return the last call of a timed policy's `select_action`, once and only if it ran the network."""
    for clock in list(_CLOCKS.values()):
        query, clock.query = clock.query, None
        if query is not None:
            return query
    return None


def _timed(select_action: Callable[..., Tensor]) -> Callable[..., Tensor]:
    def timed(self: PreTrainedPolicy, *args: Any, **kwargs: Any) -> Tensor:
        clock = _CLOCKS.get(self)
        if clock is None or clock.is_running:
            return select_action(self, *args, **kwargs)
        return clock.time(self, lambda: select_action(self, *args, **kwargs))

    return timed


class _Clock:
    def __init__(self, policy: PreTrainedPolicy) -> None:
        parameters = list(policy.parameters())
        self._device = parameters[0].device
        self._num_parameters = sum(each.numel() for each in parameters)
        self._name = _device_name(self._device)
        self.query: Query | None = None
        self.is_running = False
        _reset_peak_memory(self._device)

    def time(self, policy: PreTrainedPolicy, call: Callable[[], Tensor]) -> Tensor:
        before, self.is_running = _queue_lengths(policy), True
        try:
            self._wait()
            started = perf_counter()
            action = call()
            self._wait()
            seconds = perf_counter() - started
        finally:
            self.is_running = False
        after = _queue_lengths(policy)
        is_from_queue = any(after[name] < length for name, length in before.items() if name in after)
        self.query = None if is_from_queue else self._query(policy, seconds)
        return action

    def _wait(self) -> None:
        """Wait until the device is idle."""
        if self._device.type != "cpu":
            torch.accelerator.synchronize(self._device)

    def _query(self, policy: PreTrainedPolicy, seconds: float) -> Query:
        return Query(
            seconds=seconds,
            passes=_told(policy, "last_passes"),
            tokens=_told(policy, "last_tokens"),
            num_parameters=self._num_parameters,
            peak_memory_bytes=_peak_memory_bytes(self._device),
            device=self._name,
        )


def _queue_lengths(policy: PreTrainedPolicy) -> dict[tuple[str, ...], int]:
    """Return the lengths of a policy's queues; a call that leaves one shorter only took an action from it."""
    lengths: dict[tuple[str, ...], int] = {}
    for name, value in vars(policy).items():
        if isinstance(value, deque):
            lengths[(name,)] = len(value)
        elif isinstance(value, dict):
            lengths |= {
                (name, str(key)): len(queue) for key, queue in value.items() if isinstance(queue, deque)
            }
    return lengths


@contextmanager
def threads_of(device: str) -> Iterator[None]:
    """Compute on as many CPU threads as a record's device says: on others, sums are rounded otherwise."""
    named, before = re.fullmatch(r"cpu, (\d+) threads?", device), torch.get_num_threads()
    torch.set_num_threads(int(named[1]) if named else before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _told(policy: PreTrainedPolicy, name: str) -> Any:
    """Return a number that a policy keeps of its last query; None if it has none of this name."""
    value = getattr(policy, name, None)
    return value if type(value) in (int, float) else None


def _device_name(device: torch.device) -> str:
    """Name a device: 'NVIDIA H100', 'cpu, 1 thread'; the record also names the processor."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    if device.type == "cpu":
        num_threads = torch.get_num_threads()
        return f"cpu, {num_threads} thread{'s' * (num_threads != 1)}"
    return device.type


def _reset_peak_memory(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    elif device.type == "cpu":
        with suppress(OSError):  # where that is not allowed, it is the peak since the process began
            (PROCESS / "clear_refs").write_text(RESET_PEAK)


def _peak_memory_bytes(device: torch.device) -> int | None:
    """Return the peak memory, on a CPU of the whole process, on CUDA of tensors; None if it is not known."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    if device.type != "cpu" or not (PROCESS / "status").is_file():
        return None
    lines = (PROCESS / "status").read_text().splitlines()
    peaks = [line.split() for line in lines if line.startswith("VmHWM:")]
    return 1024 * int(peaks[0][1]) if peaks else None  # "VmHWM: 1234 kB"
