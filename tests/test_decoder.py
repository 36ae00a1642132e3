from collections.abc import Iterator
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from lerobot_bomb.actions.text import END, NUM_SYMBOLS, SPACE, SYMBOL_TEXTS
from lerobot_bomb.decoding.decoder import (
    FIRST_GUESSES,
    MAX_GUESSES,
    Answers,
    Continuation,
    Decoded,
    Guess,
    decode_numbers,
    write,
)
from lerobot_bomb.decoding.draft import KnownSymbols, LinearDraft
from lerobot_bomb.decoding.grammar import NumberGrammar, Place
from lerobot_bomb.decoding.graph_decoder import decode_ahead
from lerobot_bomb.flow.noise import gumbel


class Speaker(Continuation):
    """A model that wants to say ``texts``, one per row, whatever it is fed."""

    def __init__(self, *texts: str):
        self.wishes = torch.full((len(texts), max(map(len, texts))), END)
        self.batch_sizes: list[int] = []
        for row, text in enumerate(texts):
            symbols = [END if character == "#" else SYMBOL_TEXTS.index(character) for character in text]
            self.wishes[row, : len(text)] = torch.tensor(symbols)

    def __call__(self, symbol_BK: Tensor, first_B: Tensor) -> Tensor:
        self.batch_sizes.append(len(symbol_BK))
        columns_BK = first_B[:, None] + 1 + torch.arange(symbol_BK.shape[1])
        wanted_BK = self.wishes.gather(1, columns_BK.clamp(max=self.wishes.shape[1] - 1))
        return torch.nn.functional.one_hot(wanted_BK, NUM_SYMBOLS).float()

    def keep(self, row_B: Tensor) -> None:
        self.wishes = self.wishes[row_B]


class RandomModel(Continuation):
    """Logits that depend on all symbols before, a small causal network of fixed random numbers."""

    def __init__(self, seed: int, batch_size: int):
        generator = torch.Generator().manual_seed(seed)
        self.table = torch.randn(2000, NUM_SYMBOLS, NUM_SYMBOLS, generator=generator)
        self.history: dict[tuple[int, int], int] = {}
        self.rows = list(range(batch_size))

    def __call__(self, symbol_BK: Tensor, first_B: Tensor) -> Tensor:
        logits = []
        for row, symbols, first in zip(self.rows, symbol_BK.tolist(), first_B.tolist(), strict=True):
            for column, symbol in enumerate(symbols, first):
                before = self.history.get((row, column - 1), row)
                self.history[row, column] = (before * 31 + symbol * 7 + column) % len(self.table)
                logits.append(self.table[self.history[row, column], symbol])
        return torch.stack(logits).view(*symbol_BK.shape, NUM_SYMBOLS)

    def keep(self, row_B: Tensor) -> None:
        self.rows = [self.rows[row] for row in row_B]


def one_by_one(model: Continuation, grammar: NumberGrammar, batch_size: int) -> list[list[int]]:
    """Plain greedy decoding, one row and one symbol at a time."""
    answers = []
    for row in range(batch_size):
        text, place = [SPACE], grammar.start(1)
        while text[-1] != END:
            rows = torch.full((batch_size, 1), text[-1])
            logits = model(rows, torch.full((batch_size,), len(text) - 1))[row]
            symbol = (logits + grammar.logit_bias(place)).argmax(dim=-1)
            place = grammar.advance(place, symbol)
            text.append(int(symbol))
        answers.append([int(part) for part in "".join(SYMBOL_TEXTS[s] for s in text[:-1]).split()])
    return answers


def decode(
    model: Continuation,
    grammar: NumberGrammar,
    batch_size: int,
    *,
    guess: Guess | None = None,
    stop_after: int = 0,
) -> Decoded:
    return decode_numbers(
        model,
        grammar,
        guess or KnownSymbols(grammar),
        batch_size=batch_size,
        stop_after=stop_after or grammar.num_numbers,
    )


class Dice(Continuation):
    """Continuation with the same logits, whatever was said: those of a table (S,)."""

    def __init__(self, logits_S: Tensor):
        self.logits_S = logits_S

    def __call__(self, symbol_BK: Tensor, first_B: Tensor) -> Tensor:
        return self.logits_S.expand(*symbol_BK.shape, -1)

    def keep(self, row_B: Tensor) -> None:
        pass


def sample(seed: int, batch_size: int, grammar: NumberGrammar, **options: Any) -> Decoded:
    generator = torch.Generator().manual_seed(seed)
    logits_S = torch.randn(NUM_SYMBOLS, generator=generator)
    shape = batch_size, grammar.max_symbols(grammar.num_numbers), NUM_SYMBOLS
    return decode_numbers(
        Dice(logits_S),
        grammar,
        options.pop("guess", KnownSymbols(grammar)),
        batch_size=batch_size,
        stop_after=grammar.num_numbers,
        noise=options.pop("temperature", 1.0) * gumbel(shape, generator=generator),
    )


def test_samples_are_as_frequent_as_the_softmax_over_what_may_follow_says() -> None:
    """Numbers 00 to 34: the second digit has other choices after a 3."""
    grammar, num_rows, temperature = NumberGrammar(35, 2, fixed_width=2), 40_000, 0.7
    numbers = sample(3, num_rows, grammar, temperature=temperature).numbers
    logits_S = torch.randn(NUM_SYMBOLS, generator=torch.Generator().manual_seed(3)) / temperature
    tens = logits_S[:4].softmax(dim=0)
    ones = [logits_S[: 5 if ten == 3 else 10].softmax(dim=0) for ten in range(4)]
    expected = torch.cat([tens[ten] * ones[ten] for ten in range(4)])
    for number_B in numbers.unbind(dim=1):
        seen = torch.bincount(number_B, minlength=35)
        chi_squared = ((seen - num_rows * expected) ** 2 / (num_rows * expected)).sum()
        assert chi_squared < 66  # 34 degrees of freedom: p = 0.0008
    # the numbers of an answer are drawn apart from each other
    both = torch.bincount(35 * numbers[:, 0] + numbers[:, 1], minlength=35 * 35) / num_rows
    assert (both - torch.outer(expected, expected).flatten()).abs().max() < 0.005


def test_guesses_change_no_sample() -> None:
    grammar = NumberGrammar(100, 8, fixed_width=2)
    plain = sample(5, 64, grammar).numbers

    def guess(numbers_BN: Tensor, place: Place) -> Tensor:
        generator = torch.Generator().manual_seed(int(place.number.sum()))
        return torch.randint(0, 10, (len(place.number), 6), generator=generator)

    assert torch.equal(sample(5, 64, grammar, guess=guess).numbers, plain)
    assert not torch.equal(sample(6, 64, grammar).numbers, plain)


def test_noise_of_temperature_zero_changes_no_choice() -> None:
    grammar = NumberGrammar(512, 5)
    greedy = decode(Dice(torch.randn(NUM_SYMBOLS, generator=torch.Generator().manual_seed(7))), grammar, 3)
    assert torch.equal(sample(7, 3, grammar, temperature=0.0).numbers, greedy.numbers)


def test_what_the_model_says_is_read() -> None:
    decoded = decode(Speaker(" 5 0 511#", " 42 77 100#"), NumberGrammar(512, 3), 2)
    assert decoded.numbers.tolist() == [[5, 0, 511], [42, 77, 100]]


def test_rows_that_finish_at_different_passes_do_not_disturb_each_other() -> None:
    texts = [" 1 2#", " 400 500#", " 9 311#"]
    together = decode(Speaker(*texts), NumberGrammar(512, 2), 3).numbers
    assert together.tolist() == [[1, 2], [400, 500], [9, 311]]
    for row, text in enumerate(texts):
        assert torch.equal(decode(Speaker(text), NumberGrammar(512, 2), 1).numbers[0], together[row])


def test_rows_that_are_done_leave_the_batch() -> None:
    grammar = NumberGrammar(10_000, 2)
    texts = [" 1 2#", " 1 30#", " 1 40#", " 1 50#", " 1 6000#", " 1 7000#", " 1 8000#", " 1 9001#"]
    model = Speaker(*texts)
    decoded = decode(model, grammar, 8)
    assert decoded.numbers.tolist() == [[int(part) for part in text[:-1].split()] for text in texts]
    # a symbol a pass
    assert model.batch_sizes == [8, 8, 8, 8, 7, 4]


def test_as_many_guesses_are_asked_for_as_come_true() -> None:
    grammar = NumberGrammar(10, 40)
    asked: list[int] = []

    class Ear(Speaker):
        def __call__(self, symbol_BK: Tensor, first_B: Tensor) -> Tensor:
            asked.append(symbol_BK.shape[1] - 1)
            return super().__call__(symbol_BK, first_B)

    def guess(_: Tensor, place: Place) -> Tensor:
        """Guess right up to the 20th number; then the space and a 7 in turn."""
        after_digit_B1 = place.prefix[:, None] != grammar.START
        guess_BG = torch.where((torch.arange(MAX_GUESSES) % 2 == 0) == after_digit_B1, SPACE, 7)
        return torch.where(place.number[:, None] < 20, guess_BG, 3)

    decode(Ear(" 7" * 40 + "#"), grammar, 1, guess=guess)
    assert asked[:4] == [FIRST_GUESSES, 9, 19, MAX_GUESSES]
    assert set(asked[5:]) == {1}
    asked.clear()
    decode(Ear(" 7" * 40 + "#"), grammar, 1, guess=guess, stop_after=2)
    assert asked == [3]  # of `` 7 7 `` the first space is given, and one symbol is no guess


def test_stopping_early_gives_the_first_numbers() -> None:
    decoded = decode(Speaker(" 5 17 511 3#"), NumberGrammar(512, 4), 1, stop_after=2)
    assert decoded.numbers.tolist() == [[5, 17]]
    assert decoded.num_passes == 5  # 17 may go on to 170


def test_malformed_wishes_become_legal_numbers() -> None:
    """It wants an early end, a leading zero and 600 of 512."""
    numbers = decode(Speaker("# 07 600#"), NumberGrammar(512, 3), 1).numbers
    # a refused wish is one for any: the first symbol that is allowed
    assert numbers.tolist() == [[0, 7, 60]]


class Broken(Speaker):
    """Speaker until a column, from which one row's logits are all ``bad``."""

    def __init__(self, bad: float, column: int, row: int, *texts: str):
        super().__init__(*texts)
        self.bad, self.column, self.rows, self.row = bad, column, list(range(len(texts))), row

    def __call__(self, symbol_BK: Tensor, first_B: Tensor) -> Tensor:
        logits_BKS = super().__call__(symbol_BK, first_B)
        if self.row in self.rows:
            at = self.rows.index(self.row)
            logits_BKS[at, first_B[at] + torch.arange(logits_BKS.shape[1]) >= self.column] = self.bad
        return logits_BKS

    def keep(self, row_B: Tensor) -> None:
        super().keep(row_B)
        self.rows = [self.rows[row] for row in row_B]


BROKEN = [(bad, column) for bad in (float("nan"), float("inf"), -float("inf")) for column in (0, 3, 6)]


@pytest.mark.parametrize(("bad", "column"), BROKEN)
@pytest.mark.parametrize("drafted", [False, True])
def test_nothing_is_read_from_logits_that_are_not_finite(bad: float, column: int, drafted: bool) -> None:
    """Check rows that leave the batch when they are done, and rows that go on until all are."""
    grammar = NumberGrammar(512, 3)
    guess = LinearDraft(grammar, 1) if drafted else KnownSymbols(grammar)
    texts = " 1 2 3#", " 400 500 300#", " 9 311 77#"
    with pytest.raises(ValueError, match=r"NaN or infinite numbers for the rows \[1\] of the batch"):
        decode(Broken(bad, column, 1, *texts), grammar, 3, guess=guess)
    with pytest.raises(ValueError, match=r"NaN or infinite numbers for the rows \[1\] of the batch"):
        decode_ahead(passes(Broken(bad, column, 1, *texts), grammar, guess, 3), grammar, 3)


def test_one_logit_of_nan_is_enough() -> None:
    class OneNan(Speaker):
        def __call__(self, symbol_BK: Tensor, first_B: Tensor) -> Tensor:
            logits_BKS = super().__call__(symbol_BK, first_B)
            logits_BKS[..., 3] = torch.nan
            return logits_BKS

    with pytest.raises(ValueError, match=r"the rows \[0\]"):
        decode(OneNan(" 1 2#"), NumberGrammar(512, 2), 1)


def test_logits_after_a_wrong_guess_may_be_anything() -> None:
    """Check that nothing of them is written."""
    grammar = NumberGrammar(512, 2)

    class Shaky(Speaker):
        def __call__(self, symbol_BK: Tensor, first_B: Tensor) -> Tensor:
            logits_BKS = super().__call__(symbol_BK, first_B)
            logits_BKS[:, 1:] = torch.nan
            return logits_BKS

    def wrong(_: Tensor, place: Place) -> Tensor:
        return torch.full((len(place.number), MAX_GUESSES), 9)

    assert decode(Shaky(" 12 34#"), grammar, 1, guess=wrong).numbers.tolist() == [[12, 34]]


def test_symbols_that_cannot_be_otherwise_take_no_pass() -> None:
    """Check three digits a number: the space after them, and the end, are known."""
    grammar = NumberGrammar(512, 4, fixed_width=3)
    text = " 007 511 100 042#"
    assert grammar.max_symbols(4) == len(text)
    decoded = decode(Speaker(text), grammar, 1)
    assert decoded.numbers.tolist() == [[7, 511, 100, 42]]
    assert decoded.num_passes == 12


@pytest.mark.parametrize(
    ("text", "num_values", "width"), [(" 100 50 101 48 102 46 103 44#", 512, 0), (" 1 0 3 0 5 0 7 0#", 9, 1)]
)
def test_what_goes_on_as_before_takes_few_passes(text: str, num_values: int, width: int) -> None:
    """Check two dimensions: the first two steps are written symbol by symbol, the others are guessed."""
    grammar = NumberGrammar(num_values, 8, fixed_width=width)
    first_steps = " ".join(text[:-1].split(" ")[:5])
    undrafted = decode(Speaker(text), NumberGrammar(num_values, 8, fixed_width=width), 1, stop_after=4)
    drafted = decode(Speaker(text), grammar, 1, guess=LinearDraft(grammar, 2))
    assert drafted.numbers.tolist() == [[int(part) for part in text[:-1].split()]]
    rest = len(text) - len(first_steps) - 1
    assert drafted.num_passes <= undrafted.num_passes + -(-rest // MAX_GUESSES)


FORMS = st.tuples(st.sampled_from([1, 2, 10, 512, 999, 1001, 10_000]), st.booleans())


@settings(max_examples=80, deadline=None)
@given(
    form=FORMS,
    seed=st.integers(0, 2**31),
    batch_size=st.integers(1, 4),
    num_steps=st.integers(1, 4),
    num_dims=st.integers(1, 3),
    stop=st.integers(1, 4),
    drafted=st.booleans(),
)
def test_it_writes_what_greedy_decoding_writes(
    form: tuple[int, bool],
    seed: int,
    batch_size: int,
    num_steps: int,
    num_dims: int,
    stop: int,
    drafted: bool,
) -> None:
    num_values, zero_padded = form
    width = len(str(num_values - 1)) if zero_padded else 0
    grammar = NumberGrammar(num_values, num_steps * num_dims, fixed_width=width)
    greedy = torch.tensor(one_by_one(RandomModel(seed, batch_size), grammar, batch_size))
    guess = LinearDraft(grammar, num_dims) if drafted else KnownSymbols(grammar)
    stop_after = min(stop, num_steps) * num_dims
    decoded = decode(RandomModel(seed, batch_size), grammar, batch_size, guess=guess, stop_after=stop_after)
    assert torch.equal(decoded.numbers, greedy[:, :stop_after])


@settings(max_examples=40, deadline=None)
@given(wrong=st.integers(0, 2**31), seed=st.integers(0, 2**31))
def test_no_guess_changes_what_is_written(wrong: int, seed: int) -> None:
    grammar = NumberGrammar(512, 6)
    generator = torch.Generator().manual_seed(wrong)

    def random_guess(_: Tensor, place: Place) -> Tensor:
        return torch.randint(NUM_SYMBOLS, (len(place.number), MAX_GUESSES), generator=generator)

    greedy = one_by_one(RandomModel(seed, 3), grammar, 3)
    assert decode(RandomModel(seed, 3), grammar, 3, guess=random_guess).numbers.tolist() == greedy


def passes(model: Continuation, grammar: NumberGrammar, guess: Guess, batch_size: int) -> Iterator[Answers]:
    progress = Answers.start(grammar, batch_size)
    while True:
        progress, _ = write(model, grammar, guess, progress, MAX_GUESSES)
        yield progress


@pytest.mark.parametrize("drafted", [False, True])
def test_a_device_that_the_host_runs_ahead_of_writes_the_same(drafted: bool) -> None:
    """Rows go on beyond their end until all are done, and for one pass more."""
    for seed, (num_numbers, stop) in enumerate([(1, 1), (2, 1), (6, 2), (6, 6)]):
        grammar = NumberGrammar(512, num_numbers)
        greedy = torch.tensor(one_by_one(RandomModel(seed, 3), grammar, 3))
        guess = LinearDraft(grammar, 1) if drafted else KnownSymbols(grammar)
        decoded = decode_ahead(passes(RandomModel(seed, 3), grammar, guess, 3), grammar, stop)
        assert torch.equal(decoded.numbers, greedy[:, :stop])
        needed = (
            number
            for number, progress in enumerate(passes(RandomModel(seed, 3), grammar, guess, 3), 1)
            if progress.is_done(grammar, stop).all()
        )
        assert decoded.num_passes == next(needed) + 1
