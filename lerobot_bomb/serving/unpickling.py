"""Unpickling of the messages of LeRobot's client, without running the code that a pickle names.

A pickle may name any function and have it called with any arguments. Here it may name the two messages, and
arrays, scalars and tensors of plain numbers, which are built here from bytes of the message. What a pickle
changes in them stays in what is returned.
"""

import io
import math
import pickle
import pickletools
from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from lerobot.async_inference.helpers import RemotePolicyConfig, TimedObservation
from torch._utils import _rebuild_tensor_v2  # what a pickled tensor names

MAX_OPCODES = 20_000  # a message of a robot with a hundred joints has some thousands
MAX_FIELDS = 64  # of a message
MAX_DIMS = 32  # of an array
# operations in the pickles of these messages; others are for other objects, or from before Python 3
OPCODES = {
    "PROTO", "FRAME", "STOP", "MARK", "NONE", "NEWTRUE", "NEWFALSE", "BININT", "BININT1", "BININT2", "LONG1",
    "BINFLOAT", "SHORT_BINUNICODE", "BINUNICODE", "SHORT_BINBYTES", "BINBYTES", "BINBYTES8", "BYTEARRAY8",
    "EMPTY_TUPLE", "TUPLE", "TUPLE1", "TUPLE2", "TUPLE3", "EMPTY_LIST", "APPEND", "APPENDS", "EMPTY_DICT",
    "SETITEM", "SETITEMS", "BINGET", "LONG_BINGET", "BINPUT", "LONG_BINPUT", "MEMOIZE", "GLOBAL",
    "STACK_GLOBAL", "NEWOBJ", "REDUCE", "BUILD",
}  # fmt: skip
DTYPES = ["b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8"]
TORCH_DTYPES = (
    torch.bool, torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64,
    torch.float16, torch.bfloat16, torch.float32, torch.float64,
)  # fmt: skip
MESSAGES = {
    f"{message.__module__}.{message.__name__}": message for message in (RemotePolicyConfig, TimedObservation)
}


def loads(data: bytes | None) -> Any:
    """Read a RemotePolicyConfig or a TimedObservation.

    Raises:
        pickle.UnpicklingError: the data is something else, or the client did not finish it.
    """
    if data is None:
        raise pickle.UnpicklingError("the client ended its message before its end")
    try:
        _check_opcodes(data)
        message = _Unpickler(data).load()
    except pickle.UnpicklingError:
        raise
    except Exception as error:  # a pickle can have anything raised
        raise pickle.UnpicklingError(f"no message of LeRobot's client: {error}") from error
    if not isinstance(message, RemotePolicyConfig | TimedObservation):
        raise pickle.UnpicklingError(f"a {type(message).__name__} is no message of LeRobot's client")
    return message


def _check_opcodes(data: bytes) -> None:
    """Raise an error unless these are operations of a message, and all bytes that they read are there."""
    for number, (opcode, _, _) in enumerate(pickletools.genops(data)):
        if opcode.name not in OPCODES:
            raise pickle.UnpicklingError(f"no message of LeRobot's client has {opcode.name}")
        if number >= MAX_OPCODES:
            raise pickle.UnpicklingError(f"no message of LeRobot's client has {MAX_OPCODES} operations")


@dataclass
class _Dtype:
    """A type of plain numbers, before its byte order is known."""

    name: str
    dtype: np.dtype


class _Array:
    """An array before its contents are known."""


PythonUnpickler: Any = pickle._Unpickler  # the one in C leaves no choice of what BUILD does


class _Unpickler(PythonUnpickler):
    def __init__(self, data: bytes) -> None:
        super().__init__(io.BytesIO(data))
        self._unused = 2 * len(data)  # bytes that arrays may have; those of a tensor are first a storage's
        self._messages: dict[str, type] = {}
        self._functions = {
            "numpy.dtype": _dtype,
            "numpy.ndarray": _Array,
            "numpy._core.multiarray._reconstruct": _reconstruct,
            "numpy._core.multiarray.scalar": self._scalar,
            "numpy._core.numeric._frombuffer": self._array,
            "collections.OrderedDict": _no_hooks,
            "torch._utils._rebuild_tensor_v2": self._tensor,
            "torch.storage._load_from_bytes": self._storage,
        }

    def find_class(self, module: str, name: str) -> Any:
        path = f"{module}.{name}".replace("numpy.core.", "numpy._core.")  # NumPy 1 writes the former
        if path in self._functions:
            return self._functions[path]
        if path not in MESSAGES:
            raise pickle.UnpicklingError(f"{path} is nothing that LeRobot's client sends; it was not called")
        if path not in self._messages:  # a pickle can set attributes of a class, so it gets one of its own
            self._messages[path] = type(name, (MESSAGES[path],), {})
        return self._messages[path]

    def load_build(self) -> None:
        built, state = self.stack[-2:]
        match built:
            case _Array():
                self._fill(built, *state)
            case _Dtype():
                built.dtype = _ordered(built.name, *state)
            case _:
                self._set_fields(built, state)
                return
        self.stack.pop()

    dispatch = PythonUnpickler.dispatch | {pickle.BUILD[0]: load_build}

    def _set_fields(self, built: Any, state: Any) -> None:
        built_class = built if isinstance(built, type) else type(built)
        if built_class not in self._messages.values():
            raise pickle.UnpicklingError(f"a {built_class.__name__} of LeRobot's client has no state")
        if any(len(each or ()) > MAX_FIELDS for each in (state if isinstance(state, tuple) else (state,))):
            raise pickle.UnpicklingError(f"a message of LeRobot's client has no {MAX_FIELDS} fields")
        super().load_build()

    def _fill(self, empty: _Array, version: int, shape: Any, dtype: Any, is_fortran: Any, data: Any) -> None:
        """Put the array in place of the empty one: on the stack, and in the memo for later references."""
        array = self._array(data, dtype, shape, "F" if is_fortran else "C")
        self.stack[-2] = array
        for number in [number for number, value in self.memo.items() if value is empty]:
            self.memo[number] = array

    def _array(self, data: Any, dtype: Any, shape: Any, order: Any) -> np.ndarray:
        """Build an array as NumPy does; all its numbers must be there."""
        size = _size(shape)
        if (
            not isinstance(data, bytes | bytearray)
            or not isinstance(dtype, _Dtype)
            or order not in ("C", "F")
        ):
            raise pickle.UnpicklingError("an array of LeRobot's client has plain numbers")
        if size * dtype.dtype.itemsize != len(data):
            raise pickle.UnpicklingError(
                f"an array of {shape} {dtype.dtype} has other than {len(data)} bytes"
            )
        self._use(len(data))
        return np.frombuffer(bytearray(data), dtype.dtype).reshape(shape, order=order)

    def _scalar(self, dtype: Any, data: Any) -> Any:
        return self._array(data, dtype, (), "C")[()]

    def _storage(self, data: Any) -> Any:
        """Build a storage as torch does, but not by unpickling whatever is given."""
        if not isinstance(data, bytes):
            raise pickle.UnpicklingError("a tensor of LeRobot's client has bytes")
        self._use(len(data))
        storage = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
        if not isinstance(storage, torch.TypedStorage) or storage.dtype not in TORCH_DTYPES:
            raise pickle.UnpicklingError("a tensor of LeRobot's client has plain numbers")
        return storage

    def _tensor(
        self, storage: Any, offset: Any, size: Any, stride: Any, requires_grad: Any, hooks: Any
    ) -> torch.Tensor:
        """Build a tensor as torch does, of a storage that holds all of it."""
        numel = _size(size)
        _size(stride)
        if not isinstance(storage, torch.TypedStorage) or type(offset) is not int or len(size) != len(stride):
            raise pickle.UnpicklingError("a tensor of LeRobot's client has a storage, an offset and strides")
        item_bytes = storage.dtype.itemsize
        last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
        if offset < 0 or (numel and (last + 1) * item_bytes > storage._untyped_storage.nbytes()):
            raise pickle.UnpicklingError(f"a tensor of {size} does not lie in its storage")
        self._use(numel * item_bytes)
        return _rebuild_tensor_v2(storage, offset, size, stride, requires_grad is True, OrderedDict())

    def _use(self, num_bytes: int) -> None:
        """Raise an UnpicklingError where the same bytes become array after array."""
        self._unused -= num_bytes
        if self._unused < 0:
            raise pickle.UnpicklingError("the arrays hold more than the message")


def _dtype(name: Any, *_: Any) -> _Dtype:
    if name not in DTYPES:
        raise pickle.UnpicklingError(f"no array of LeRobot's client has the dtype {name!r:.80}")
    return _Dtype(name, np.dtype(name))


def _ordered(name: str, version: int, order: Any, *others: Any) -> np.dtype:
    """Return a dtype with the byte order of its state, which for plain numbers says nothing else."""
    if order not in ("<", ">", "|", "=") or others != (None, None, None, -1, -1, 0):
        raise pickle.UnpicklingError("an array of LeRobot's client has plain numbers")
    return np.dtype(name).newbyteorder(order)


def _reconstruct(array_type: Any, *_: Any) -> _Array:
    if array_type is not _Array:
        raise pickle.UnpicklingError("an array of LeRobot's client is NumPy's")
    return _Array()


def _no_hooks() -> OrderedDict[str, Any]:
    """Return a tensor's hooks, which are none."""
    return OrderedDict()


def _size(shape: Any) -> int:
    """Return how many numbers an array of this shape has."""
    is_shape = isinstance(shape, tuple) and len(shape) <= MAX_DIMS
    if not is_shape or any(type(length) is not int or length < 0 for length in shape):
        raise pickle.UnpicklingError(f"{shape!r:.80} is no shape of an array")
    return math.prod(shape)
