"""The language of answers: `` n1 n2 ... nN<end>``, as a deterministic automaton on tensors.

Every number is in 0..num_values - 1, without sign or leading zeros, or zero-padded to a fixed width.
Shapes: `B` batch, `S` symbols, `G` symbols of a walk, `K` = 1 + G, `V` values of a number, `C` columns that a
number may take.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from lerobot_bomb.actions.text import END, NUM_SYMBOLS, SPACE, digits_needed, number_symbols


@dataclass(frozen=True)
class Place:
    """Places in an answer where rows of symbols stand; both fields have the same shape, int64."""

    prefix: Tensor  # state of `NumberGrammar`: the digits of the number so far
    number: Tensor  # which number they belong to, from 0

    def at(self, index_B: Tensor) -> "Place":
        """(B, K) places -> (B,) places, of one column in each row."""
        index_B1 = index_B[:, None]
        return Place(self.prefix.gather(1, index_B1)[:, 0], self.number.gather(1, index_B1)[:, 0])


class NumberGrammar(nn.Module):
    """Transition tables of answers of ``num_numbers`` numbers.

    A state is a beginning of a number; `START` is the empty one, just after a space, and `DONE` follows the
    end.

    Raises:
        ValueError: there is no number to write, or no value that it can take, or the width is too small.
    """

    bias: Tensor  # (2, states, S) float32: 0 where a symbol may follow, else -inf; [1]: the last number
    next_state: Tensor  # (states, S) int64
    must_end: Tensor  # (states,) bool: a number that no digit may follow
    num_digits: Tensor  # (states,) int64
    value: Tensor  # (states,) int64
    spelling: Tensor  # (V, C) int64 symbols of every number, the space before it first
    is_spelled: Tensor  # (V, C) bool, which of them are written

    DONE, START = 0, 1

    def __init__(self, num_values: int, num_numbers: int, *, fixed_width: int = 0):
        super().__init__()
        if num_values < 1 or num_numbers < 1:
            raise ValueError(f"a grammar of {num_numbers} numbers with {num_values} values has no answers")
        if fixed_width and fixed_width < digits_needed(num_values):
            raise ValueError(
                f"{num_values} values do not fit into {fixed_width} digits; {digits_needed(num_values)} do"
            )
        self.num_values, self.num_numbers, self.fixed_width = num_values, num_numbers, fixed_width
        prefixes = self._prefixes()
        state_of = {prefix: self.START + i for i, prefix in enumerate(prefixes)}
        digits_PD = [
            [state_of.get(f"{prefix}{digit}", self.DONE) for digit in range(10)] for prefix in prefixes
        ]
        is_number = torch.tensor([False, *map(self._is_number, prefixes)])
        next_state = torch.full((1 + len(prefixes), NUM_SYMBOLS), self.DONE)
        next_state[1:, :SPACE] = torch.tensor(digits_PD)
        next_state[is_number, SPACE] = self.START
        allowed = torch.stack([next_state != self.DONE] * 2)
        allowed[1, :, SPACE] = False
        allowed[1, :, END] = is_number
        allowed[:, self.DONE, END] = True  # rows that are done repeat the end
        bias = torch.zeros(allowed.shape).masked_fill(~allowed, -torch.inf)
        values_V1 = torch.arange(num_values)[:, None]
        spelling, is_spelled = number_symbols(values_V1, self.width, zero_padded=fixed_width > 0)
        for name, table in {
            "bias": bias,
            "next_state": next_state,
            "must_end": is_number & (next_state[:, :SPACE] == self.DONE).all(dim=1),
            "num_digits": torch.tensor([0, *map(len, prefixes)]),
            "value": torch.tensor([0, *(int(prefix or 0) for prefix in prefixes)]),
            "spelling": spelling.squeeze(1),
            "is_spelled": is_spelled.squeeze(1),
        }.items():
            self.register_buffer(name, table, persistent=False)

    @property
    def width(self) -> int:
        """Digits of the longest number."""
        return self.fixed_width or digits_needed(self.num_values)

    def _prefixes(self) -> list[str]:
        """Return all beginnings of all numbers, the empty one first."""
        numbers = [str(value).zfill(self.fixed_width) for value in range(self.num_values)]
        beginnings = {number[:length] for number in numbers for length in range(len(number) + 1)}
        return sorted(beginnings, key=lambda prefix: (len(prefix), prefix))

    def _is_number(self, prefix: str) -> bool:
        return len(prefix) == self.fixed_width if self.fixed_width else prefix != ""

    def max_symbols(self, num_numbers: int) -> int:
        """Return the most symbols that this number of numbers takes, with the symbol after them."""
        return num_numbers * (1 + self.width) + 1

    def start(self, batch_size: int) -> Place:
        """(B,) places after the first space, which every answer begins with."""
        prefix_B = torch.full((batch_size,), self.START, device=self.next_state.device)
        return Place(prefix_B, torch.zeros_like(prefix_B))

    def advance(self, place: Place, symbol: Tensor) -> Place:
        """Return the place after one more symbol."""
        return Place(self.next_state[place.prefix, symbol], place.number + (symbol == SPACE))

    def walk(self, place: Place, symbol_BG: Tensor) -> Place:
        """(B,) -> (B, 1 + G) places: this one and those after each of the symbols."""
        prefixes = [place.prefix]
        for symbol_B in symbol_BG.unbind(dim=1):
            prefixes.append(self.next_state[prefixes[-1], symbol_B])
        num_spaces_BK = nn.functional.pad((symbol_BG == SPACE).cumsum(dim=1), (1, 0))
        return Place(torch.stack(prefixes, dim=1), place.number[:, None] + num_spaces_BK)

    def is_last(self, place: Place) -> Tensor:
        """Return True where the number is the answer's last, which the end follows instead of a space."""
        return place.number == self.num_numbers - 1

    def logit_bias(self, place: Place) -> Tensor:
        """(..., S) float32: 0 for symbols that may follow, -inf for others."""
        return self.bias[self.is_last(place).long(), place.prefix]
