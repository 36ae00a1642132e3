from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from transformers import LogitsProcessor

from lerobot_bomb.actions.text import END, NUM_SYMBOLS, SPACE, SYMBOL_TEXTS, TokenRows
from lerobot_bomb.decoding.decoder import (
    MAX_GUESSES,
    CachedContinuation,
    Decoded,
    Guess,
    NextLogits,
    decode_numbers,
    pick,
    read_answer,
)
from lerobot_bomb.decoding.draft import KnownSymbols, LinearDraft
from lerobot_bomb.decoding.grammar import NumberGrammar, Place
from lerobot_bomb.vlm.backbone import SmolVLMBackbone, load_backbone


def speaker(*texts: str) -> NextLogits:
    """A model that wants to say ``texts``, one per row, whatever it is fed."""
    wishes = torch.full((len(texts), max(map(len, texts))), END)
    for row, text in enumerate(texts):
        symbols = [END if character == "#" else SYMBOL_TEXTS.index(character) for character in text]
        wishes[row, : len(text)] = torch.tensor(symbols)

    def next_logits(symbol_BK: Tensor, first_B: Tensor) -> Tensor:
        columns_BK = first_B[:, None] + 1 + torch.arange(symbol_BK.shape[1])
        wanted_BK = wishes.gather(1, columns_BK.clamp(max=wishes.shape[1] - 1))
        return torch.nn.functional.one_hot(wanted_BK, NUM_SYMBOLS).float()

    return next_logits


def random_model(seed: int) -> NextLogits:
    """Logits that depend on all symbols before, a small causal network of fixed random numbers."""
    generator = torch.Generator().manual_seed(seed)
    table = torch.randn(2000, NUM_SYMBOLS, NUM_SYMBOLS, generator=generator)
    history: dict[tuple[int, int], int] = {}

    def next_logits(symbol_BK: Tensor, first_B: Tensor) -> Tensor:
        rows = []
        for row, (symbols, first) in enumerate(zip(symbol_BK.tolist(), first_B.tolist(), strict=True)):
            for column, symbol in enumerate(symbols, first):
                before = history.get((row, column - 1), row)
                history[row, column] = (before * 31 + symbol * 7 + column) % len(table)
                rows.append(table[history[row, column], symbol])
        return torch.stack(rows).view(*symbol_BK.shape, NUM_SYMBOLS)

    return next_logits


def one_by_one(model: NextLogits, grammar: NumberGrammar, batch_size: int) -> list[list[int]]:
    """Plain greedy decoding, one row and one symbol at a time."""
    answers = []
    for row in range(batch_size):
        text, place = [SPACE], grammar.start(1)
        while text[-1] != END:
            rows = torch.full((batch_size, 1), text[-1])
            logits = model(rows, torch.full((batch_size,), len(text) - 1))[row]
            symbol = (logits + grammar.penalties(place)).argmax(dim=-1)
            place = grammar.advance(place, symbol)
            text.append(int(symbol))
        answers.append([int(part) for part in "".join(SYMBOL_TEXTS[s] for s in text[:-1]).split()])
    return answers


def decode(
    model: NextLogits,
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


def test_what_the_model_says_is_read() -> None:
    decoded = decode(speaker(" 5 0 511#", " 42 77 100#"), NumberGrammar(512, 3), 2)
    assert decoded.numbers.tolist() == [[5, 0, 511], [42, 77, 100]]


def test_rows_that_finish_at_different_passes_do_not_disturb_each_other() -> None:
    texts = [" 1 2#", " 400 500#", " 9 311#"]
    together = decode(speaker(*texts), NumberGrammar(512, 2), 3).numbers
    assert together.tolist() == [[1, 2], [400, 500], [9, 311]]
    for row, text in enumerate(texts):
        assert torch.equal(decode(speaker(text), NumberGrammar(512, 2), 1).numbers[0], together[row])


def test_stopping_early_gives_the_first_numbers() -> None:
    decoded = decode(speaker(" 5 17 511 3#"), NumberGrammar(512, 4), 1, stop_after=2)
    assert decoded.numbers.tolist() == [[5, 17]]
    assert decoded.num_passes == 5  # 17 may go on to 170


def test_malformed_wishes_become_legal_numbers() -> None:
    """It wants an early end, a leading zero and 600 of 512."""
    numbers = decode(speaker("# 07 600#"), NumberGrammar(512, 3), 1).numbers
    assert ((numbers >= 0) & (numbers < 512)).all()


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_only_a_choice_is_picked_even_from_broken_logits(bad: float) -> None:
    penalty = torch.full((1, NUM_SYMBOLS), -torch.inf)
    penalty[0, SPACE] = 0
    assert pick(torch.full((1, NUM_SYMBOLS), bad), penalty).tolist() == [SPACE]


def test_symbols_that_cannot_be_otherwise_take_no_pass() -> None:
    """Three digits a number: the space after them, and the end, are known."""
    grammar = NumberGrammar(512, 4, fixed_width=3)
    text = " 007 511 100 042#"
    assert grammar.max_symbols == len(text)
    decoded = decode(speaker(text), grammar, 1)
    assert decoded.numbers.tolist() == [[7, 511, 100, 42]]
    assert decoded.num_passes == 12


@pytest.mark.parametrize(
    ("text", "num_values", "width"), [(" 100 50 101 48 102 46 103 44#", 512, 0), (" 1 0 3 0 5 0 7 0#", 9, 1)]
)
def test_what_goes_on_as_before_takes_few_passes(text: str, num_values: int, width: int) -> None:
    """Two dimensions: the first two steps are written symbol by symbol, the others are guessed."""
    grammar = NumberGrammar(num_values, 8, fixed_width=width)
    first_steps = " ".join(text[:-1].split(" ")[:5])
    undrafted = decode(speaker(text), NumberGrammar(num_values, 8, fixed_width=width), 1, stop_after=4)
    drafted = decode(speaker(text), grammar, 1, guess=LinearDraft(grammar, 2))
    assert drafted.numbers.tolist() == [[int(part) for part in text[:-1].split()]]
    rest = len(text) - len(first_steps) - 1
    assert drafted.num_passes <= undrafted.num_passes + -(-rest // MAX_GUESSES)


@pytest.mark.parametrize(
    ("written", "guessed"),
    [
        ("", "255 255 "),  # nothing to go by: the middle
        ("10 20", "9 10 209"),  # the second is not known to be complete
        ("10 20 13", " 20 16 "),
        ("10 20 13 ", "20 16 20"),
        ("10 20 13 2", "0 16 20#"),
        ("10 20 13 3", "0 16 40#"),  # 20 was expected; the nearest number with this beginning
        ("10 20 13 1", "9 16 18#"),
        ("500 3 510 1 511", " 0###"),  # within the bins' range
        ("10 20 30 40 50", " 60###"),  # the last number
    ],
)
def test_the_line_is_drawn_through_the_last_two_steps(written: str, guessed: str) -> None:
    grammar = NumberGrammar(512, 6)
    symbols = [SPACE, *map(SYMBOL_TEXTS.index, written)]
    place = grammar.start(1)
    for symbol in symbols[1:]:
        place = grammar.advance(place, torch.tensor([symbol]))
    row = torch.full((1, grammar.max_symbols + MAX_GUESSES + 1), END)
    row[0, : len(symbols)] = torch.tensor(symbols)
    guess = LinearDraft(grammar, 2)(row, place)[0].tolist()
    said = "".join("#" if symbol == END else SYMBOL_TEXTS[symbol] for symbol in guess)
    assert said.startswith(guessed)


FORMS = st.tuples(st.sampled_from([2, 10, 512, 999, 1001]), st.booleans())


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
    greedy = torch.tensor(one_by_one(random_model(seed), grammar, batch_size))
    guess = LinearDraft(grammar, num_dims) if drafted else KnownSymbols(grammar)
    stop_after = min(stop, num_steps) * num_dims
    decoded = decode(random_model(seed), grammar, batch_size, guess=guess, stop_after=stop_after)
    assert torch.equal(decoded.numbers, greedy[:, :stop_after])


@settings(max_examples=40, deadline=None)
@given(wrong=st.integers(0, 2**31), seed=st.integers(0, 2**31))
def test_no_guess_changes_what_is_written(wrong: int, seed: int) -> None:
    grammar = NumberGrammar(512, 6)
    generator = torch.Generator().manual_seed(wrong)

    def random_guess(_: Tensor, place: Place) -> Tensor:
        return torch.randint(NUM_SYMBOLS, (len(place.number), MAX_GUESSES), generator=generator)

    greedy = one_by_one(random_model(seed), grammar, 3)
    assert decode(random_model(seed), grammar, 3, guess=random_guess).numbers.tolist() == greedy


def test_answers_are_read_to_the_wanted_number() -> None:
    symbols = torch.tensor([[10, 1, 2, 10, 0, 10, 9, 9, 9], [10, 7, 10, 8, 11, 11, 11, 11, 11]])
    assert read_answer(symbols, 2).tolist() == [[12, 0], [7, 8]]


# On a model

SYMBOL_IDS = torch.arange(20, 20 + NUM_SYMBOLS)


@pytest.fixture(scope="module")
def backbone() -> SmolVLMBackbone:
    torch.manual_seed(0)
    return load_backbone("nano").eval()


def prompts(backbone: SmolVLMBackbone, seed: int, lengths: list[int]) -> TokenRows:
    generator = torch.Generator().manual_seed(seed)
    ids = torch.randint(40, 300, (len(lengths), max(lengths)), generator=generator)
    return TokenRows(ids, torch.arange(max(lengths)) < torch.tensor(lengths)[:, None])


def continuation(backbone: SmolVLMBackbone, rows: TokenRows, max_symbols: int) -> CachedContinuation:
    return CachedContinuation(
        backbone, backbone.embed_tokens(rows.ids), rows.written, SYMBOL_IDS, max_symbols
    )


@torch.no_grad()
def test_the_cache_gives_the_logits_of_a_full_pass(backbone: SmolVLMBackbone) -> None:
    """Rows of different lengths that get on differently far, one of them twice over the same columns."""
    rows = prompts(backbone, 0, [9, 4])
    said = torch.tensor([[3, 10, 4, 1, 9, 10, 2], [10, 8, 5, 7, 1, 10, 6]])
    model = continuation(backbone, rows, 9)
    model(said[:, :2], torch.tensor([0, 0]))
    model(torch.tensor([[4, 1, 9], [0, 0, 0]]), torch.tensor([2, 2]))  # wrong guesses in the second row
    cached = model(torch.stack([said[0, 5:7], said[1, 2:4]]), torch.tensor([5, 2]))
    for row, (length, num_said) in enumerate([(9, 7), (4, 4)]):
        full = torch.cat([rows.ids[row, :length], SYMBOL_IDS[said[row, :num_said]]])[None]
        expected = backbone.logits(backbone.hidden_states(backbone.embed_tokens(full)))[0, -2:, SYMBOL_IDS]
        torch.testing.assert_close(cached[row], expected)


class GrammarProcessor(LogitsProcessor):
    """The grammar for transformers' `generate`, told by a regular expression's worth of Python."""

    def __init__(self, num_values: int, num_numbers: int, prompt_length: int):
        self.num_values, self.num_numbers, self.prompt_length = num_values, num_numbers, prompt_length

    def __call__(self, input_ids: Tensor, scores: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        masked = torch.full_like(scores, -torch.inf)
        for row, ids in enumerate(input_ids[:, self.prompt_length :].tolist()):
            text = "".join(SYMBOL_TEXTS[token - 20] if token != 20 + END else "#" for token in ids)
            for symbol in self.choices(text):
                masked[row, 20 + symbol] = scores[row, 20 + symbol]
        return masked

    def choices(self, text: str) -> list[int]:
        if "#" in text or not text:
            return [END] if text else list(range(10))
        *_, number = text.split(" ")
        more = [digit for digit in range(10) if number != "0" and int(f"{number}{digit}") < self.num_values]
        if not number:
            return more
        return [*more, SPACE if text.count(" ") + 1 < self.num_numbers else END]


@torch.no_grad()
@pytest.mark.parametrize("lengths", [[30], [30, 24, 17, 30, 5, 12, 29, 30]])
@pytest.mark.parametrize("drafted", [False, True])
def test_it_writes_what_generate_writes(backbone: SmolVLMBackbone, lengths: list[int], drafted: bool) -> None:
    """transformers' own greedy search with its own cache, left-padded, under the same language."""
    grammar, batch_size = NumberGrammar(512, 12), len(lengths)
    for seed in range(4):
        rows = prompts(backbone, seed, lengths)
        guess = LinearDraft(grammar, 3) if drafted else KnownSymbols(grammar)
        model = continuation(backbone, rows, grammar.max_symbols)
        ours = decode(model, grammar, batch_size, guess=guess).numbers
        longest = max(lengths) + 1
        ids = torch.zeros(batch_size, longest, dtype=torch.long)
        mask = torch.zeros_like(ids)
        for row, length in enumerate(lengths):
            ids[row, -length - 1 :] = torch.cat([rows.ids[row, :length], SYMBOL_IDS[SPACE : SPACE + 1]])
            mask[row, -length - 1 :] = 1
        model_of_peer: Any = backbone.vlm
        written = model_of_peer.generate(
            input_ids=ids,
            attention_mask=mask,
            max_new_tokens=grammar.max_symbols,
            do_sample=False,
            logits_processor=[GrammarProcessor(512, 12, longest)],
            eos_token_id=20 + END,
            pad_token_id=20 + END,
        )
        for row in range(batch_size):
            symbols = (written[row, longest:] - 20).tolist()
            text = "".join(SYMBOL_TEXTS[symbol] for symbol in symbols if symbol != END)
            assert ours[row].tolist() == [int(part) for part in text.split()]


def test_an_answer_longer_than_the_models_positions_is_refused(backbone: SmolVLMBackbone) -> None:
    rows = prompts(backbone, 0, [30])
    with pytest.raises(
        ValueError, match=r"up to 4097 tokens, and the model has 4096 positions; give a smaller"
    ):
        continuation(backbone, rows, 4067)
    continuation(backbone, rows, 4066)
