import re

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_bomb.actions.text import END, SPACE, SYMBOL_TEXTS
from lerobot_bomb.decoding.grammar import NumberGrammar

SYMBOL_OF = {text: i for i, text in enumerate(SYMBOL_TEXTS)}


def after(grammar: NumberGrammar, text: str, numbers_left: int = 1) -> str:
    """Symbols that may follow a text, ``#`` for the end."""
    state = torch.tensor([grammar.BOUNDARY])
    for character in text:
        assert grammar.allowed[state, SYMBOL_OF[character]], f"{character!r} is refused in {text!r}"
        state = grammar.advance(state, torch.tensor([SYMBOL_OF[character]]))
    choices = grammar.choices(state, torch.tensor([numbers_left]))[0]
    return "".join("#" if i == END else SYMBOL_TEXTS[i] for i in choices.nonzero().flatten().tolist())


@pytest.mark.parametrize(
    ("text", "follows"),
    [
        ("", " "),
        (" ", "0123456789"),
        (" 0", " "),
        (" 5", "0123456789 "),
        (" 51", "01 "),
        (" 50", "0123456789 "),
        (" 52", " "),
        (" 59", " "),
        (" 60", " "),
        (" 9", "0123456789 "),
        (" 511", " "),
        (" 511 ", "0123456789"),
    ],
)
def test_numbers_below_512(text: str, follows: str) -> None:
    assert after(NumberGrammar(512), text) == follows


def test_the_end_comes_after_the_last_number_and_only_there() -> None:
    grammar = NumberGrammar(512)
    assert after(grammar, " 0", numbers_left=0) == "#"
    assert after(grammar, " 51", numbers_left=0) == "01#"
    assert after(grammar, " ", numbers_left=0) == "0123456789"


def test_fixed_width() -> None:
    grammar = NumberGrammar(512, fixed_width=3)
    assert after(grammar, " ") == "012345"
    assert after(grammar, " 0") == "0123456789"
    assert after(grammar, " 51") == "01"
    assert after(grammar, " 007") == " "
    assert after(grammar, " 007", numbers_left=0) == "#"
    assert after(NumberGrammar(7, fixed_width=2), " ") == "0"


@settings(max_examples=60, deadline=None)
@given(
    num_values=st.sampled_from([2, 10, 11, 512, 999, 1000, 1001]),
    zero_padded=st.booleans(),
    seed=st.integers(0, 2**31),
    num_numbers=st.integers(1, 6),
)
def test_every_walk_is_a_list_of_numbers(
    num_values: int, zero_padded: bool, seed: int, num_numbers: int
) -> None:
    width = len(str(num_values - 1)) if zero_padded else 0
    grammar = NumberGrammar(num_values, fixed_width=width)
    generator = torch.Generator().manual_seed(seed)
    state, begun, text, value = torch.tensor([grammar.BOUNDARY]), 0, "", []
    while True:
        choices = grammar.choices(state, torch.tensor([num_numbers - begun]))[0].float()
        symbol = int(torch.multinomial(choices, 1, generator=generator))
        if symbol >= SPACE and begun:
            value.append(int(grammar.value[state]))
        if symbol == END:
            break
        begun += symbol == SPACE
        text += SYMBOL_TEXTS[symbol]
        state = grammar.advance(state, torch.tensor([symbol]))
    number = rf"[0-9]{{{width}}}" if zero_padded else "(0|[1-9][0-9]*)"
    assert re.fullmatch(f"( {number}){{{num_numbers}}}", text)
    assert [int(part) for part in text.split()] == value
    assert all(0 <= part < num_values for part in value)


@settings(max_examples=30, deadline=None)
@given(num_values=st.integers(2, 1200), zero_padded=st.booleans())
def test_every_number_can_be_written(num_values: int, zero_padded: bool) -> None:
    width = len(str(num_values - 1)) if zero_padded else 0
    grammar = NumberGrammar(num_values, fixed_width=width)
    reached = grammar.value[grammar.is_number]
    assert sorted(reached.tolist()) == list(range(num_values))
    for number in {0, num_values // 2, num_values - 1}:
        assert " " in after(grammar, f" {str(number).zfill(width)}")
