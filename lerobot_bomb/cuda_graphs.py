"""CUDA graphs: the kernels of a function, captured once and started together afterwards."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn


@dataclass(frozen=True)
class _Captured:
    graph: torch.cuda.CUDAGraph
    taken: tuple[Tensor, ...]
    returned: tuple[Tensor, ...]


class GraphedFunction:
    """A function of tensors that is captured once for each set of their shapes and types.

    The function must do the same work every time: no branch on a value, no random number, and all else that
    it reads stays at its address. The next call with the same shapes overwrites the returned tensors. Off
    CUDA, the function itself is called. A copy has captured nothing.
    """

    def __init__(self, function: Callable[..., tuple[Tensor, ...]]):
        self._function = function
        self._graphs: dict[Any, _Captured] = {}
        self._pool: Any = None  # memory of all graphs, which take turns

    def __getstate__(self) -> dict[str, Any]:
        return {"_function": self._function, "_graphs": {}, "_pool": None}

    def __call__(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        """Run the function on the tensors; call it outside of inference mode."""
        if not tensors[0].is_cuda:
            return self._function(*tensors)
        shapes = tuple((tensor.shape, tensor.dtype) for tensor in tensors)
        if shapes not in self._graphs:
            with _without_cached_casts():
                self._graphs[shapes] = self._capture(tensors)
        captured = self._graphs[shapes]
        for taken, given in zip(captured.taken, tensors, strict=True):
            taken.copy_(given)
        captured.graph.replay()
        return captured.returned

    def _capture(self, tensors: tuple[Tensor, ...]) -> _Captured:
        taken = tuple(tensor.clone() for tensor in tensors)
        # libraries set themselves up in their first calls, which cannot be captured
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            self._function(*taken)
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        # other threads, such as those of a data loader, may go on
        with torch.cuda.graph(graph, self._pool, capture_error_mode="thread_local"):
            returned = self._function(*taken)
        self._pool = graph.pool()
        return _Captured(graph, taken, returned)


class GraphedModel:
    """A function of tensors that also reads the weights of modules in place.

    Under autocast, the weights of linear layers are cast once per call. The function is captured anew when
    weights have moved or the settings differ. Arguments are as for `GraphedFunction`.
    """

    def __init__(self, function: Callable[..., tuple[Tensor, ...]], modules: Iterable[nn.Module]):
        self._call = _Call(function, modules)
        self._state: Any = None
        self._captured = GraphedFunction(self._run)

    def __call__(self, settings: Any, *tensors: Tensor) -> tuple[Tensor, ...]:
        """Run the function on the tensors; ``settings`` holds whatever else it reads."""
        read = [*self._call.parameters(), *self._call.buffers()]
        state = settings, [tensor.data_ptr() for tensor in read]
        if state != self._state:
            self._state, self._captured = state, GraphedFunction(self._run)
        return self._captured(*tensors)

    def _run(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        weights: dict[str, Tensor] = {}
        if torch.is_autocast_enabled("cuda"):
            dtype = torch.get_autocast_dtype("cuda")
            products = [(name, part) for name, part in self._call.named_modules() if type(part) is nn.Linear]
            for name, product in products:
                for kind, parameter in product.named_parameters(recurse=False):
                    weights[f"{name}.{kind}"] = parameter.to(dtype)
        return torch.func.functional_call(self._call, weights, tensors)


class _Call(nn.Module):
    """Wraps a function as a module that holds the modules it reads."""

    def __init__(self, function: Callable[..., tuple[Tensor, ...]], modules: Iterable[nn.Module]):
        super().__init__()
        self._modules_read = nn.ModuleList(modules)
        self._function = function

    def forward(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        return self._function(*tensors)


@contextmanager
def _without_cached_casts() -> Iterator[None]:
    """Turn off autocast's cache during a capture: its casts live no longer than autocast does."""
    was_enabled = torch.is_autocast_cache_enabled()
    torch.clear_autocast_cache()
    torch.set_autocast_cache_enabled(False)
    try:
        yield
    finally:
        torch.set_autocast_cache_enabled(was_enabled)
