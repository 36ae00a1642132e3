import math

import pytest
import torch

from lerobot_bomb.actions.text import (
    SYMBOL_TEXTS,
    NumberTokens,
    TokenRows,
    compact,
    digits_needed,
    draw_hidden,
    number_symbols,
)


def write(numbers: list[list[int]], width: int, zero_padded: bool = False) -> list[str]:
    symbols, written = number_symbols(torch.tensor(numbers), width, zero_padded=zero_padded)
    rows = zip(symbols.flatten(1), written.flatten(1), strict=True)
    return ["".join(SYMBOL_TEXTS[i] for i in row[keep]) for row, keep in rows]


def test_numbers_as_text() -> None:
    assert write([[0, 7, 10, 99, 100, 511]], width=3) == [" 0 7 10 99 100 511"]
    assert write([[0, 7], [511, 64]], width=3, zero_padded=True) == [" 000 007", " 511 064"]
    assert write([[5]], width=5, zero_padded=True) == [" 00005"]


@pytest.mark.parametrize(
    ("num_values", "digits"), [(2, 1), (10, 1), (11, 2), (512, 3), (999, 3), (1000, 3), (1001, 4)]
)
def test_digits_needed(num_values: int, digits: int) -> None:
    assert digits_needed(num_values) == digits


@pytest.mark.parametrize(("num_numbers", "tokens"), [(20, 81), (56, 225), (140, 561)])
def test_length_of_an_answer_of_fixed_width(num_numbers: int, tokens: int) -> None:
    _, written = number_symbols(torch.full((1, num_numbers), 3), 3, zero_padded=True)
    assert int(written.sum()) + 1 == tokens  # and the end


def test_compact_takes_padding_out_and_cuts_what_no_row_needs() -> None:
    written = torch.tensor([[1, 0, 0, 1, 0], [0, 1, 1, 0, 1]], dtype=torch.bool)
    ids = torch.tensor([[1, 2, 3, 4, 5], [6, 7, 8, 9, 10]])
    written, ids = compact(written, ids)
    assert written.tolist() == [[True, True, False], [True, True, True]]
    assert ids[written].tolist() == [1, 4, 7, 8, 10]


def tokens_of(number: int) -> NumberTokens:
    symbols, written = number_symbols(torch.tensor([[number, 42]]), 3, zero_padded=False)
    return NumberTokens(symbols, written, written)


@pytest.mark.parametrize("number", [7, 85, 425])
def test_a_hidden_number_is_one_token_whatever_its_digits(number: int) -> None:
    hidden = tokens_of(number).hide_numbers(torch.tensor([[True, False]]), hidden_id=77)
    assert hidden.ids[hidden.mask].tolist() == [10, 77, 10, 4, 2]
    assert hidden.ids[hidden.loss_mask].tolist() == [10, 10, 4, 2]


def test_a_hidden_character_keeps_its_place() -> None:
    columns = torch.zeros(1, 2, 4, dtype=torch.bool)
    columns[0, 0, 2] = columns[0, 1, 0] = True
    hidden = tokens_of(425).hide_characters(columns, hidden_id=77)
    assert hidden.ids[hidden.mask].tolist() == [10, 4, 77, 5, 77, 4, 2]
    assert hidden.ids[hidden.loss_mask].tolist() == [10, 4, 5, 4, 2]


def hidden_counts(rows: int, units: int, max_fraction: float, skip_prob: float) -> torch.Tensor:
    eligible = torch.ones(rows, units, dtype=torch.bool)
    hidden = draw_hidden(eligible, max_fraction, skip_prob, torch.Generator().manual_seed(0))
    return hidden.sum(dim=1)


def test_hidden_share_of_20_numbers_at_15_percent() -> None:
    counts = hidden_counts(40_000, 20, 0.15, 0.1)
    assert counts.max() == 2
    # floor(20 f) is 0 for f < 0.05: 0.1 + 0.9 / 3
    assert (counts == 0).float().mean().item() == pytest.approx(0.40, abs=0.01)
    assert (counts / 20).mean().item() == pytest.approx(0.045, abs=0.001)


def test_hidden_share_of_56_numbers_at_10_percent() -> None:
    counts = hidden_counts(40_000, 56, 0.1, 0.1)
    assert counts.max() == 5
    expected = 0.9 * sum(k * (min((k + 1) / 56, 0.1) - k / 56) / 0.1 for k in range(6)) / 56
    assert math.isclose(expected, 0.037, abs_tol=5e-4)
    assert (counts / 56).mean().item() == pytest.approx(expected, abs=0.001)


def test_skipping_always_and_hiding_all() -> None:
    assert hidden_counts(100, 20, 1.0, 1.0).sum() == 0
    assert hidden_counts(2_000, 20, 1.0, 0.0).max() == 19  # floor of less than 20
    assert hidden_counts(100, 20, 0.0, 0.0).sum() == 0


def test_only_eligible_units_are_hidden_and_every_one_is_at_times() -> None:
    eligible = torch.tensor([True, False, True, True]).expand(500, 4)
    hidden = draw_hidden(eligible, 1.0, 0.0, torch.Generator().manual_seed(0))
    assert hidden.any(dim=0).tolist() == [True, False, True, True]


def test_the_same_seed_hides_the_same() -> None:
    eligible = torch.ones(8, 40, dtype=torch.bool)
    draws = [draw_hidden(eligible, 0.5, 0.0, torch.Generator().manual_seed(s)) for s in (3, 3, 4)]
    assert torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])


def test_rows_are_rounded_up_with_padding() -> None:
    rows = TokenRows(torch.tensor([[4, 5, 6]]), torch.tensor([[True, False, True]]))
    rounded = rows.rounded(4)
    assert rounded.ids.shape == (1, 4) and rounded.mask.tolist() == [[True, False, True, False]]
    assert rounded.without_padding().ids.tolist() == [[4, 6]]
    assert rounded.rounded(4).ids.shape == (1, 4)


def test_hidden_tokens_keep_their_columns() -> None:
    mask = torch.tensor([[True, False, True]])
    rows = TokenRows(torch.tensor([[4, 5, 6]]), mask, torch.tensor([[False, False, True]]))
    joined = TokenRows.join([TokenRows(torch.tensor([[3]]), torch.tensor([[True]])), rows]).rounded(6)
    assert joined.ids.tolist() == [[3, 4, 5, 6, 0, 0]]
    assert joined.attention_mask.tolist() == [[True, True, False, False, False, False]]
    compacted = joined.without_padding()
    assert compacted.ids.tolist() == [[3, 4, 6]] and compacted.mask.tolist() == [[True, True, True]]
    assert compacted.hidden is not None and compacted.hidden.tolist() == [[False, False, True]]
    assert TokenRows.join([rows, rows]).without_padding().attention_mask.tolist() == [
        [True, False, True, False]
    ]
    nothing = TokenRows(rows.ids, mask)
    assert TokenRows.join([nothing]).hidden is None and nothing.attention_mask is mask
