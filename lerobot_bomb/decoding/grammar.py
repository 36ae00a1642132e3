"""The language of answers: `` n1 n2 ... nN<end>``, as a deterministic automaton on tensors.

Every number is in 0..num_values - 1, without sign or leading zeros, or zero-padded to a fixed width.
"""

import torch
from torch import Tensor, nn

from lerobot_bomb.actions.text import END, SPACE


class NumberGrammar(nn.Module):
    """Transition tables over digit prefixes; the count of numbers is kept by the caller.

    State 0 is the boundary before a number's space; state ``1 + i`` is the i-th prefix. A number is
    complete in the states where `is_number` holds, and `value` is its value there.
    """

    allowed: Tensor  # (states, NUM_SYMBOLS) bool, space and end as far as the prefix decides
    next_state: Tensor  # (states, NUM_SYMBOLS) int64; where not allowed: 0
    value: Tensor  # (states,) int64
    is_number: Tensor  # (states,) bool

    BOUNDARY = 0

    def __init__(self, num_values: int, *, fixed_width: int = 0):
        super().__init__()
        self.num_values = num_values
        self.fixed_width = fixed_width
        prefixes = self._prefixes()
        state_of = {prefix: 1 + i for i, prefix in enumerate(prefixes)}
        to_space = [0] * SPACE + [state_of[""], 0]
        next_state = [to_space]  # 0 where a symbol is not allowed, and after the end
        for prefix in prefixes:
            digits = [state_of.get(f"{prefix}{digit}", 0) for digit in range(10)]
            next_state.append([*digits, *(to_space[SPACE:] if self._is_number(prefix) else (0, 0))])
        is_number = torch.tensor([False, *map(self._is_number, prefixes)])
        table = torch.tensor(next_state)
        allowed = table > 0
        allowed[:, END] = is_number
        self.register_buffer("next_state", table, persistent=False)
        self.register_buffer("allowed", allowed, persistent=False)
        self.register_buffer("is_number", is_number, persistent=False)
        values = torch.tensor([0, *(int(prefix or 0) for prefix in prefixes)])
        self.register_buffer("value", values, persistent=False)

    def _prefixes(self) -> list[str]:
        """All beginnings of all numbers, the empty one first."""
        numbers = [str(value).zfill(self.fixed_width) for value in range(self.num_values)]
        beginnings = {number[:length] for number in numbers for length in range(len(number) + 1)}
        return sorted(beginnings, key=lambda prefix: (len(prefix), prefix))

    def _is_number(self, prefix: str) -> bool:
        return len(prefix) == self.fixed_width if self.fixed_width else prefix != ""

    def choices(self, state_B: Tensor, numbers_left_B: Tensor) -> Tensor:
        """(B, NUM_SYMBOLS) bool: what may follow when ``numbers_left_B`` numbers have yet to begin."""
        choices_BS = self.allowed[state_B].clone()
        choices_BS[:, SPACE] &= numbers_left_B > 0
        choices_BS[:, END] &= numbers_left_B == 0
        return choices_BS

    def advance(self, state_B: Tensor, symbol_B: Tensor) -> Tensor:
        """(B,) states after one symbol each; the end leads back to the boundary."""
        return self.next_state[state_B, symbol_B]
