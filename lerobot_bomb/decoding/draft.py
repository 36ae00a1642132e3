"""Guesses of an answer's next tokens; right or wrong, they change only the number of passes.

Shapes: `B` batch, `N` numbers, `W` those that guesses can reach, `C` columns a number may take,
`M` = (1 + W) * C, `G` guesses.
"""

import torch
from torch import Tensor

from lerobot_bomb.actions.text import END, SPACE
from lerobot_bomb.decoding.decoder import MAX_GUESSES
from lerobot_bomb.decoding.grammar import NumberGrammar, Place


class KnownSymbols:
    """Draft of one space or end, which is right wherever a number cannot go on."""

    def __init__(self, grammar: NumberGrammar):
        self._grammar = grammar

    def __call__(self, _: Tensor, place: Place) -> Tensor:
        """(B, 1) guesses; (B, 0) if the host sees that no row's number has to end."""
        must_end_B = self._grammar.must_end[place.prefix]
        if not must_end_B.is_cuda and not bool(must_end_B.any()):
            return place.prefix.new_empty(len(place.prefix), 0)
        return torch.where(self._grammar.is_last(place), END, SPACE)[:, None]


class LinearDraft:
    """Draft that continues every action dimension on the line through the last two steps of the answer."""

    def __init__(self, grammar: NumberGrammar, num_dims: int, num_before: int = 0):
        """``num_before``: numbers of the answer that precede its actions and follow no line."""
        self._grammar, self._num_dims, self._num_before = grammar, num_dims, num_before

    def __call__(self, number_BN: Tensor, place: Place) -> Tensor:
        """(B, G) guesses."""
        grammar, first_B1 = self._grammar, place.number[:, None]
        begun_B1 = self._complete(number_BN, place)[:, None]
        known_BN = number_BN.scatter(1, first_B1, begun_B1)
        # every number takes two symbols or more
        ahead_W = torch.arange(MAX_GUESSES // 2, device=number_BN.device)
        next_BW = self._expect(known_BN, first_B1 + 1 + ahead_W % self._num_dims, ahead_W // self._num_dims)
        numbers = torch.cat([begun_B1, next_BW], dim=1)
        mask_BWC = grammar.is_spelled[numbers]
        mask_BWC[:, 1:] &= (first_B1 + 1 + ahead_W < grammar.num_numbers)[..., None]
        # the space and the digits that are written are no guesses
        start_B1 = 1 + grammar.num_digits[place.prefix][:, None]
        columns_BG = start_B1 + torch.arange(MAX_GUESSES, device=number_BN.device)
        return self._spell(grammar.spelling[numbers].flatten(1), mask_BWC.flatten(1)).gather(1, columns_BG)

    def _spell(self, symbol_BM: Tensor, mask_BM: Tensor) -> Tensor:
        """Spell symbols without the padding between them, then ends; no row's length has to be known."""
        num_columns = symbol_BM.shape[1] + MAX_GUESSES + 1
        column_BM = (mask_BM.cumsum(dim=1) - 1).masked_fill(~mask_BM, num_columns)
        spelled = symbol_BM.new_full((len(symbol_BM), num_columns + 1), END)
        return spelled.scatter(1, column_BM, symbol_BM)

    def _complete(self, number_BN: Tensor, place: Place) -> Tensor:
        """(B,) the number that is being written, as near to the expected one as its beginning allows.

        Without zero padding, only numbers with as many digits as expected are considered.
        """
        grammar = self._grammar
        expected_B = self._expect(number_BN, place.number[:, None], 0).squeeze(1)
        num_digits_B = grammar.num_digits[place.prefix]
        rest_B = grammar.is_spelled[expected_B].sum(dim=1) - 1 - num_digits_B
        value_B, scale_B = grammar.value[place.prefix], 10 ** rest_B.clamp(min=0)
        low_B, high_B = value_B * scale_B, (value_B + 1) * scale_B - 1
        goes_on_B = (low_B < grammar.num_values) & ~grammar.must_end[place.prefix]
        nearest_B = torch.where(goes_on_B, expected_B.clamp(low_B, high_B), value_B)
        return torch.where(num_digits_B > 0, nearest_B, expected_B)

    def _expect(self, number_BN: Tensor, index_BX: Tensor, steps: Tensor | int) -> Tensor:
        """(B, X) the number ``steps`` after an unknown one, on the line through the two steps before that.

        Without a step before, the middle of the range; without two, no slope.
        """
        middle = (self._grammar.num_values - 1) // 2
        last_BX, before_BX = (
            number_BN.gather(1, (index_BX - back * self._num_dims).clamp(0, number_BN.shape[1] - 1))
            for back in (1, 2)
        )
        second = self._num_before + self._num_dims  # where the second step begins
        last_BX = torch.where(index_BX >= second, last_BX, middle)
        before_BX = torch.where(index_BX >= second + self._num_dims, before_BX, last_BX)
        line_BX = last_BX + (last_BX - before_BX) * (steps + 1)
        return line_BX.clamp(0, self._grammar.num_values - 1)
