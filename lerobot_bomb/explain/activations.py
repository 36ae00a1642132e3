"""Activations of a language model: recorded, and put back into a pass over other inputs.

Shapes: `U` units, `N` rows of a pass, `L` tokens, `F` features.
"""

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

from torch import Tensor, nn

from lerobot_bomb.explain.scored_policy import DecoderLayer, TokenSpan

# a part of a layer: its output; the heads' outputs, side by side; the output of its MLP
LAYER, HEADS, MLP = "layer", "heads", "mlp"
PARTS = (LAYER, HEADS, MLP)

# outputs in each pass of a score, (N, L, F) each, by layer and part
type Activations = dict[tuple[int, str], list[Tensor]]
type Change = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Unit:
    """Part of a language model whose activations are put back at once."""

    layer: int
    part: str
    head: int | None = None  # of HEADS; None: all of them
    span: TokenSpan | None = None  # which tokens; None: all of them


@contextmanager
def recording(layers: Sequence[DecoderLayer], parts: Sequence[str] = PARTS) -> Iterator[Activations]:
    """Keep the outputs of the layers' parts, in all passes until the end of the block."""
    kept: Activations = defaultdict(list)

    def keep(key: tuple[int, str], values: Tensor) -> Tensor:
        kept[key].append(values.detach().clone())
        return values

    keys = [(i, part) for i in range(len(layers)) for part in parts]
    with _changed(layers, {key: partial(keep, key) for key in keys}):
        yield kept


@contextmanager
def restoring(
    layers: Sequence[DecoderLayer],
    clean: Activations,
    units_of_rows: Sequence[Sequence[Unit]],
) -> Iterator[None]:
    """Put units of ``clean`` back into each row, in the passes of one score.

    ``clean`` is of one row. A pass may have several adjacent rows for each row of the score.
    """
    restored: dict[tuple[int, str], list[tuple[int, Unit]]] = defaultdict(list)
    for row, units in enumerate(units_of_rows):
        for unit in units:
            restored[unit.layer, unit.part].append((row, unit))
    changes: dict[tuple[int, str], Change] = {
        (layer, part): _Restore(
            clean[layer, part], restored[layer, part], len(units_of_rows), layers[layer].num_heads
        )
        for layer, part in restored
    }
    with _changed(layers, changes):
        yield


@dataclass
class _Restore:
    """Puts one part back, in the passes of one score."""

    clean: list[Tensor]
    units: list[tuple[int, Unit]]  # (row of the score, unit put back there)
    num_rows: int  # of the score
    num_heads: int
    num_passes: int = 0  # so far

    def __call__(self, values_NLF: Tensor) -> Tensor:
        clean_NLF = self.clean[self.num_passes]
        restored = values_NLF.clone().unflatten(0, (self.num_rows, -1))
        size = values_NLF.shape[2] // self.num_heads
        for row, unit in self.units:
            features = slice(None) if unit.head is None else slice(unit.head * size, (unit.head + 1) * size)
            columns = slice(None) if unit.span is None else unit.span[self.num_passes]
            if columns is not None:
                restored[row][:, columns, features] = clean_NLF[:, columns, features]
        self.num_passes += 1
        return restored.flatten(0, 1)


@contextmanager
def _changed(layers: Sequence[DecoderLayer], changes: Mapping[tuple[int, str], Change]) -> Iterator[None]:
    """Change the outputs of parts; the hooks are removed afterwards, whatever happens.

    Raises:
        ValueError: the layers' own outputs cannot be hooked.
    """
    with ExitStack() as stack:
        for (layer, part), change in changes.items():
            stack.callback(_hook(layers[layer], part, change).remove)
        yield


def _hook(layer: DecoderLayer, part: str, change: Change) -> Any:
    if part == HEADS:
        return layer.attention_out.register_forward_pre_hook(lambda _, args: (change(args[0]), *args[1:]))
    module: nn.Module | None = layer.layer if part == LAYER else layer.mlp
    if module is None:
        raise ValueError(
            "this policy calls the parts of its layers one by one, so their states cannot be put back; "
            "attention heads and MLPs can"
        )
    return module.register_forward_hook(lambda _, args, output: _on_first(change, output))


def _on_first(change: Change, output: Any) -> Any:
    """Change what a module returns, which may be states, or a tuple of states and more."""
    if isinstance(output, tuple):
        return change(output[0]), *output[1:]
    return change(output)


def all_layers(num_layers: int, span: TokenSpan | None = None) -> list[Unit]:
    """Return every layer's output, at a span of tokens."""
    return [Unit(layer, LAYER, span=span) for layer in range(num_layers)]


def all_heads(layers: Sequence[DecoderLayer]) -> list[Unit]:
    """Return every attention head, layer by layer."""
    return [Unit(i, HEADS, head) for i, layer in enumerate(layers) for head in range(layer.num_heads)]


def all_mlps(num_layers: int) -> list[Unit]:
    """Return every MLP."""
    return [Unit(layer, MLP) for layer in range(num_layers)]
