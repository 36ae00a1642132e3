import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from lerobot_bomb.actions.text import END, NUM_SYMBOLS, SPACE, SYMBOL_TEXTS
from lerobot_bomb.decoding.decoder import CachedContinuation, NextLogits, decode_numbers, pick
from lerobot_bomb.decoding.grammar import NumberGrammar
from lerobot_bomb.vlm.backbone import SmolVLMBackbone, load_backbone


def speaker(*texts: str) -> NextLogits:
    """A model that wants to say ``texts``, one per row, whatever it is fed."""
    step = -1

    def next_logits(_: Tensor | None) -> Tensor:
        nonlocal step
        step += 1
        logits = torch.zeros(len(texts), NUM_SYMBOLS)
        for row, text in enumerate(texts):
            if step < len(text):
                logits[row, END if text[step] == "#" else SYMBOL_TEXTS.index(text[step])] = 1.0
        return logits

    return next_logits


def random_model(seed: int, batch_size: int) -> NextLogits:
    generator = torch.Generator().manual_seed(seed)
    return lambda _: torch.randn(batch_size, NUM_SYMBOLS, generator=generator) * 10


def test_what_the_model_says_is_read() -> None:
    numbers = decode_numbers(
        speaker(" 5 0 511#", " 42 77 100#"), NumberGrammar(512), batch_size=2, num_numbers=3, stop_after=3
    )
    assert numbers.tolist() == [[5, 0, 511], [42, 77, 100]]


def test_rows_that_finish_at_different_steps_do_not_disturb_each_other() -> None:
    texts = [" 1 2#", " 400 500#", " 9 311#"]
    together = decode_numbers(speaker(*texts), NumberGrammar(512), batch_size=3, num_numbers=2, stop_after=2)
    assert together.tolist() == [[1, 2], [400, 500], [9, 311]]
    for row, text in enumerate(texts):
        alone = decode_numbers(speaker(text), NumberGrammar(512), batch_size=1, num_numbers=2, stop_after=2)
        assert torch.equal(alone[0], together[row])


def test_stopping_early_gives_the_first_numbers() -> None:
    numbers = decode_numbers(
        speaker(" 5 17 511 3#"), NumberGrammar(512), batch_size=1, num_numbers=4, stop_after=2
    )
    assert numbers.tolist() == [[5, 17]]


def test_malformed_wishes_become_legal_numbers() -> None:
    """It wants an early end, a leading zero and 600 of 512."""
    numbers = decode_numbers(
        speaker("# 07 600#"), NumberGrammar(512), batch_size=1, num_numbers=3, stop_after=3
    )
    assert ((numbers >= 0) & (numbers < 512)).all()


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_only_a_choice_is_picked_even_from_broken_logits(bad: float) -> None:
    choices = torch.zeros(1, NUM_SYMBOLS, dtype=torch.bool)
    choices[0, SPACE] = True
    assert pick(torch.full((1, NUM_SYMBOLS), bad), choices).tolist() == [SPACE]


@settings(max_examples=50, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    num_values=st.sampled_from([2, 512, 999, 1001]),
    zero_padded=st.booleans(),
    batch_size=st.integers(1, 4),
    num_numbers=st.integers(1, 12),
)
def test_random_logits_always_give_numbers_in_range(
    seed: int, num_values: int, zero_padded: bool, batch_size: int, num_numbers: int
) -> None:
    grammar = NumberGrammar(num_values, fixed_width=len(str(num_values - 1)) if zero_padded else 0)
    numbers = decode_numbers(
        random_model(seed, batch_size),
        grammar,
        batch_size=batch_size,
        num_numbers=num_numbers,
        stop_after=num_numbers,
    )
    assert numbers.shape == (batch_size, num_numbers)
    assert ((numbers >= 0) & (numbers < num_values)).all()


@pytest.fixture(scope="module")
def backbone() -> SmolVLMBackbone:
    torch.manual_seed(0)
    return load_backbone("nano").eval()


@torch.no_grad()
def test_the_cache_gives_the_logits_of_a_full_pass(backbone: SmolVLMBackbone) -> None:
    """Rows of different lengths, gaps at the end of the shorter prompt."""
    symbol_ids = torch.arange(20, 20 + NUM_SYMBOLS)
    prompts = [torch.arange(40, 49), torch.arange(60, 64)]
    ids = torch.nn.utils.rnn.pad_sequence(prompts, batch_first=True)
    written = torch.arange(9) < torch.tensor([[9], [4]])
    model = CachedContinuation(backbone, backbone.embed_tokens(ids), written, symbol_ids)
    said = torch.tensor([[3, 10, 4], [7, 8, 11]])
    cached = [model(None), *(model(symbols) for symbols in said.T)]
    for row, prompt in enumerate(prompts):
        full = torch.cat([prompt, symbol_ids[said[row]]])[None]
        hidden = backbone.hidden_states(
            backbone.embed_tokens(full), torch.ones_like(full), torch.arange(full.shape[1])[None]
        )
        expected = backbone.logits(hidden)[0, len(prompt) - 1 :, symbol_ids]
        torch.testing.assert_close(torch.stack([step[row] for step in cached]), expected)
