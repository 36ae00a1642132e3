"""Unpickling by the policy server: LeRobot's messages, as pickle reads them, and nothing that harms it."""

import pickle
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fresh_processes import FreshProcess
from lerobot.async_inference.helpers import RemotePolicyConfig, TimedObservation
from test_serve_limits import Runs
from torch._utils import _rebuild_tensor_v2

from lerobot_bomb.serving.unpickling import loads


@pytest.mark.parametrize("protocol", range(3, pickle.HIGHEST_PROTOCOL + 1))
def test_what_lerobots_client_sends_is_read_as_pickle_reads_it(protocol: int) -> None:
    features: Any = {"observation.state": {"dtype": "float32", "shape": (2,), "names": ["a.pos", "b.pos"]}}
    policy = RemotePolicyConfig("act", "me/x", features, 10, "cpu", {"a": "b"})
    assert vars(loads(pickle.dumps(policy, protocol))) == vars(policy)
    image = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    sent = {
        "a.pos": 1.5,
        "b.pos": np.float32(2.5),
        "front": image,
        "wrist": image[:, ::2],
        "depth": torch.arange(6.0).reshape(2, 3),
        "task": "Place it.",
    }
    observation = TimedObservation(1.0, 3, sent, must_go=True)
    read = loads(pickle.dumps(observation, protocol))
    assert isinstance(read, TimedObservation)
    assert (read.get_timestamp(), read.get_timestep(), read.must_go) == (1.0, 3, True)
    assert read.get_observation().keys() == sent.keys()
    for name, value in sent.items():
        found = read.get_observation()[name]
        assert type(found) is type(value)
        np.testing.assert_array_equal(found, value)


def test_a_tensor_holds_no_pickle_of_its_own(tmp_path: Path) -> None:
    """torch unpickles a tensor's bytes."""

    class Nested:
        def __reduce__(self) -> tuple:
            return torch.storage._load_from_bytes, (pickle.dumps(Runs(tmp_path / "made")),)

    with pytest.raises(Exception, match=r"weights_only|Weights only"):
        loads(pickle.dumps(TimedObservation(0.0, 0, {"a": Nested()})))
    assert not (tmp_path / "made").exists()


def test_a_pickle_changes_no_class_of_the_process() -> None:
    """BUILD with (None, {"get_timestamp": 1}) sets an attribute of the class that GLOBAL named."""
    named = b"\x80\x02clerobot.async_inference.helpers\nTimedObservation\n"
    with pytest.raises(pickle.UnpicklingError, match="a type is no message"):
        loads(named + b"N}X\x0d\x00\x00\x00get_timestampK\x01s\x86b.")
    assert callable(TimedObservation.get_timestamp)


numpy_core: Any = np._core  # pyright: ignore
OBJECTS = np.dtype("O")
FLOATS = np.dtype("f4")
FRAMES = bytes(1 << 20)


class Calls:
    """A pickle of it calls a function with these arguments, and has the result take a state."""

    def __init__(self, function: Any, *args: Any, state: Any = None):
        self.reduced = (function, args, state)

    def __reduce__(self) -> tuple:
        return self.reduced


def state(shape: Any, dtype: Any, data: Any) -> tuple:
    """Return the state of an array."""
    return 1, shape, dtype, False, data


def array(shape: Any, dtype: Any, data: Any) -> Calls:
    return Calls(numpy_core.multiarray._reconstruct, np.ndarray, (0,), b"b", state=state(shape, dtype, data))


def buffer(data: Any, dtype: Any, shape: Any, order: str = "C") -> Calls:
    return Calls(numpy_core.numeric._frombuffer, data, dtype, shape, order)


def dtype_with(*state: Any) -> Calls:
    return Calls(np.dtype, "f4", False, True, state=state)


def tensor(offset: Any, size: Any, stride: Any) -> Calls:
    """Return the call that makes a tensor of a storage of six numbers."""
    return Calls(
        _rebuild_tensor_v2,
        torch.arange(6.0).storage(),
        offset,
        size,
        stride,
        False,
        OrderedDict(),
    )


HOSTILE = {
    # NumPy reads the buffer's bytes as pointers to objects: the process ends
    "objects at addresses": lambda: Calls(np.ndarray, (1,), OBJECTS, b"AAAAAAAA"),
    "objects": lambda: np.array([None, {}], dtype=object),
    "objects in a buffer": lambda: buffer(b"AAAAAAAA", OBJECTS, (1,)),
    "objects in a state": lambda: array((1,), OBJECTS, b"AAAAAAAA"),
    "an object as a scalar": lambda: Calls(numpy_core.multiarray.scalar, OBJECTS, b"AAAAAAAA"),
    "fields": lambda: np.zeros(2, dtype=[("a", "f4"), ("b", "O")]),
    "text": lambda: np.array(["a", "b"]),
    "a subarray": lambda: array((1,), np.dtype(("f4", (4,))), bytes(16)),
    "a dtype with fields": lambda: array(
        (1,), dtype_with(3, "<", None, ("a",), {"a": 1}, -1, -1, 0), bytes(4)
    ),
    "a dtype that is longer": lambda: array(
        (1,), dtype_with(3, "<", None, None, None, 1 << 40, 1, 0), bytes(4)
    ),
    "a huge shape": lambda: array((1 << 40,), FLOATS, bytes(4)),
    "a shape past 64 bits": lambda: array((1 << 62, 1 << 62), FLOATS, b""),
    "a negative shape": lambda: array((-1, -4), FLOATS, bytes(16)),
    "a shape that is no tuple": lambda: buffer(bytes(16), FLOATS, -1),
    "a shape of many dimensions": lambda: array((1,) * 65, FLOATS, bytes(4)),
    "no bytes": lambda: array((1,), FLOATS, [1.0]),
    "an array called with strides": lambda: Calls(np.ndarray, (9,), FLOATS, FRAMES, 0, (-4,)),
    "a tensor past its storage": lambda: tensor(0, (1 << 33,), (1,)),
    "a tensor before its storage": lambda: tensor(-1, (6,), (1,)),
    "a tensor with negative strides": lambda: tensor(5, (6,), (-1,)),
    "a tensor of one number everywhere": lambda: tensor(0, (1 << 33,), (0,)),
    "the same bytes again and again": lambda: [buffer(FRAMES, FLOATS, (1 << 18,)) for _ in range(1000)],
    "hooks": lambda: Calls(OrderedDict, [(1, 2)]),
    "many operations": lambda: [0] * 30_000,
}
# pickles that no object gives
CRAFTED = {
    "a memo of gigabytes": b"\x80\x04K\x00r" + (1 << 30).to_bytes(4, "little") + b".",
    "bytes that are not there": b"\x80\x04\x8e" + (1 << 50).to_bytes(8, "little") + b".",
    "bytes for writing that are not there": b"\x80\x05\x96" + (1 << 33).to_bytes(8, "little") + b".",
    "lists in lists": b"\x80\x04" + b"]" * 1_000_000 + b"a" * 999_999 + b".",
    "an end without a beginning": b"\x80\x04.",
    "nothing": b"",
}
UNPICKLE = """
import resource, sys
from pickle import UnpicklingError
from lerobot_bomb.serving.unpickling import loads
resource.setrlimit(resource.RLIMIT_CPU, (300, 300))
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for path in sys.argv[1:]:
    try:
        message = loads(open(path, "rb").read())
    except UnpicklingError as error:
        print(path.rpartition("/")[2], "refused:", error)
    else:
        print(path.rpartition("/")[2], "read:", repr(message)[:200])
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) >> 10)
"""
MAX_MORE_MIB = 200


def test_a_hostile_pickle_ends_no_process_and_takes_no_memory(tmp_path: Path) -> None:
    pickles = {
        name: pickle.dumps(TimedObservation(0.0, 0, {"a": make()}), protocol=5)
        for name, make in HOSTILE.items()
    }
    paths = [tmp_path / name for name in (*pickles, *CRAFTED)]
    for path, data in zip(paths, (*pickles.values(), *CRAFTED.values()), strict=True):
        path.write_bytes(data)
    done = FreshProcess(UNPICKLE, *map(str, paths), cwd=tmp_path).wait()
    assert done.returncode == 0, done.stderr
    *refused, more_mib = done.stdout.splitlines()
    assert [line.partition(" refused: ")[0] for line in refused] == [path.name for path in paths]
    assert int(more_mib) < MAX_MORE_MIB


@pytest.mark.parametrize("protocol", range(3, pickle.HIGHEST_PROTOCOL + 1))
@pytest.mark.parametrize(
    "value",
    [
        np.arange(6, dtype=">f4").reshape(2, 3),
        np.asfortranarray(np.arange(6, dtype="f2").reshape(2, 3)),
        np.zeros((0, 3)),
        np.array(2.5),
        np.bool_(True),
        np.int64(-3),
        torch.arange(6.0).reshape(2, 3).T,
        torch.zeros(0, dtype=torch.int64),
        torch.tensor(True),
    ],
    ids=repr,
)
def test_numbers_are_read_as_pickle_reads_them(value: Any, protocol: int) -> None:
    sent = TimedObservation(0.0, 0, {"a": value, "b": [value, value]})
    read = loads(pickle.dumps(sent, protocol)).get_observation()
    assert read["a"] is read["b"][0] is read["b"][1] or isinstance(value, np.generic)
    found: Any
    for found in (read["a"], read["b"][1]):
        assert (type(found), found.dtype, found.shape) == (type(value), value.dtype, value.shape)
        np.testing.assert_array_equal(found, value)


def test_something_else_is_no_message() -> None:
    with pytest.raises(pickle.UnpicklingError, match="a dict is no message"):
        loads(pickle.dumps({}))
    with pytest.raises(pickle.UnpicklingError, match="ended its message"):
        loads(None)
