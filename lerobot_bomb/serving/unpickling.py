"""What LeRobot's client sends to its policy server, unpickled without running what a pickle names.

A pickle may name any function and have it called; here it may name the two messages, NumPy's arrays and
torch's tensors only. Whatever it does to what it gets stays in what is returned.
"""

import io
import pickle
from collections import OrderedDict
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from lerobot.async_inference.helpers import RemotePolicyConfig, TimedObservation
from numpy._core import multiarray
from torch._utils import _rebuild_tensor_v2  # what a pickled tensor names


def loads(data: bytes | None) -> Any:
    """A RemotePolicyConfig or a TimedObservation.

    Raises:
        pickle.UnpicklingError: it is something else, or the client sent no end.
    """
    if data is None:
        raise pickle.UnpicklingError("the client ended its message before its end")
    message = _Unpickler(io.BytesIO(data)).load()
    if not isinstance(message, RemotePolicyConfig | TimedObservation):
        raise pickle.UnpicklingError(f"a {type(message).__name__} is no message of LeRobot's client")
    return message


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        path = f"{module}.{name}".replace("numpy.core.", "numpy._core.")  # NumPy 1 writes the former
        if path in ALLOWED:
            return ALLOWED[path]()
        raise pickle.UnpicklingError(f"{path} is nothing that LeRobot's client sends; it was not called")


def _a_class_of_its_own(of: type) -> type:
    """A pickle can set attributes of a class that it names, so it gets one that nothing else uses."""
    return type(of.__name__, (of,), {})


def _storage(data: bytes) -> Any:
    """As torch's own, which however unpickles what it is given."""
    return torch.load(io.BytesIO(data), weights_only=True)


def _array(data: Any, dtype: np.dtype, shape: tuple[int, ...], order: str) -> np.ndarray:
    """As NumPy's own, of the bytes that newer pickles hold apart."""
    return np.frombuffer(data, dtype=dtype).reshape(shape, order=order)  # pyright: ignore


ALLOWED: dict[str, Callable[[], Any]] = {
    "lerobot.async_inference.helpers.RemotePolicyConfig": partial(_a_class_of_its_own, RemotePolicyConfig),
    "lerobot.async_inference.helpers.TimedObservation": partial(_a_class_of_its_own, TimedObservation),
    "numpy.ndarray": lambda: np.ndarray,
    "numpy.dtype": lambda: np.dtype,
    "numpy._core.multiarray._reconstruct": lambda: partial(multiarray._reconstruct),
    "numpy._core.multiarray.scalar": lambda: partial(multiarray.scalar),
    "numpy._core.numeric._frombuffer": lambda: partial(_array),
    "collections.OrderedDict": lambda: OrderedDict,
    "torch._utils._rebuild_tensor_v2": lambda: partial(_rebuild_tensor_v2),
    "torch.storage._load_from_bytes": lambda: partial(_storage),
}
