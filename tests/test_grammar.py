import re

import pytest
import torch
import xgrammar
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_bomb.actions.text import END, NUM_SYMBOLS, SPACE, SYMBOL_TEXTS
from lerobot_bomb.decoding.grammar import NumberGrammar, Place

SYMBOL_OF = {text: i for i, text in enumerate(SYMBOL_TEXTS)} | {"#": END}
ALL_FORMS = st.tuples(st.sampled_from([1, 2, 10, 11, 100, 512, 999, 1000, 1001]), st.integers(0, 4)).filter(
    lambda form: form[1] == 0 or form[0] <= 10 ** form[1]
)


def after(grammar: NumberGrammar, text: str) -> str:
    """Symbols that may follow a text, ``#`` for the end; the automaton starts after the first space."""
    assert text[0] == " "
    place = grammar.start(1)
    for character in text[1:]:
        assert grammar.logit_bias(place)[0, SYMBOL_OF[character]] == 0, (
            f"{character!r} is refused in {text!r}"
        )
        place = grammar.advance(place, torch.tensor([SYMBOL_OF[character]]))
    return allowed(grammar, place)


def allowed(grammar: NumberGrammar, place: Place) -> str:
    symbols = (grammar.logit_bias(place)[0] == 0).nonzero().flatten().tolist()
    return "".join("#" if i == END else SYMBOL_TEXTS[i] for i in symbols)


@pytest.mark.parametrize(
    ("text", "follows"),
    [
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
        (" 511 0", "#"),
        (" 511 51", "01#"),
        (" 511 511", "#"),
        (" 511 511#", "#"),  # and nothing else, for ever
    ],
)
def test_two_numbers_below_512(text: str, follows: str) -> None:
    assert after(NumberGrammar(512, 2), text) == follows


def test_fixed_width() -> None:
    grammar = NumberGrammar(512, 2, fixed_width=3)
    assert after(grammar, " ") == "012345"
    assert after(grammar, " 0") == "0123456789"
    assert after(grammar, " 51") == "01"
    assert after(grammar, " 007") == " "
    assert after(grammar, " 007 007") == "#"
    assert after(NumberGrammar(7, 1, fixed_width=2), " ") == "0"


def test_the_longest_answer() -> None:
    assert NumberGrammar(512, 2).max_symbols(2) == len(" 511 511#")
    assert NumberGrammar(512, 2).max_symbols(1) == len(" 511 ")


def test_numbers_that_must_end() -> None:
    grammar = NumberGrammar(512, 1)
    ending = {text for text in ("", "0", "5", "51", "52", "99", "123") if must_end(grammar, text)}
    assert ending == {"0", "52", "99", "123"}


def must_end(grammar: NumberGrammar, digits: str) -> bool:
    place = grammar.start(1)
    for digit in digits:
        place = grammar.advance(place, torch.tensor([int(digit)]))
    return bool(grammar.must_end[place.prefix])


def in_language(text: str, num_values: int, num_numbers: int, width: int) -> bool:
    """An independent parser."""
    number = rf"[0-9]{{{width}}}" if width else "(?:0|[1-9][0-9]*)"
    if not re.fullmatch(f"(?: {number}){{{num_numbers}}}#", text):
        return False
    return all(int(part) < num_values for part in text[:-1].split())


@settings(max_examples=200, deadline=None)
@given(form=ALL_FORMS, num_numbers=st.integers(1, 4), data=st.data())
def test_it_accepts_what_an_independent_parser_accepts(
    form: tuple[int, int], num_numbers: int, data: st.DataObject
) -> None:
    """Answers, and answers with one character changed, inserted or deleted."""
    num_values, width = form
    numbers = data.draw(st.lists(st.integers(0, num_values), min_size=num_numbers, max_size=num_numbers))
    text = "".join(f" {str(number).zfill(width)}" for number in numbers) + "#"
    at = data.draw(st.integers(1, len(text)))
    cut = data.draw(st.integers(0, 1))
    text = text[:at] + data.draw(st.sampled_from(["", *SYMBOL_OF])) + text[at + cut :]
    grammar = NumberGrammar(num_values, num_numbers, fixed_width=width)
    place, accepted = grammar.start(1), True
    for character in text[1:]:
        accepted &= character in allowed(grammar, place) and bool(place.prefix != grammar.DONE)
        place = grammar.advance(place, torch.tensor([SYMBOL_OF[character]]))
    accepted &= bool(place.prefix == grammar.DONE)
    assert accepted == in_language(text, num_values, num_numbers, width)


@settings(max_examples=60, deadline=None)
@given(form=ALL_FORMS, num_numbers=st.integers(1, 4), seed=st.integers(0, 2**31))
def test_its_choices_are_those_of_xgrammar(form: tuple[int, int], num_numbers: int, seed: int) -> None:
    """Walk through the language at random: the same symbols may follow, step by step."""
    num_values, width = form
    grammar = NumberGrammar(num_values, num_numbers, fixed_width=width)
    values = " | ".join(f'"{str(value).zfill(width)}"' for value in range(num_values))
    rules = f'root ::= {" ".join(["value"] * num_numbers)}\nvalue ::= " " ({values})\n'
    tokenizer = xgrammar.TokenizerInfo(
        [*SYMBOL_TEXTS, "#"], vocab_type=xgrammar.VocabType.RAW, stop_token_ids=[END]
    )
    matcher = xgrammar.GrammarMatcher(xgrammar.GrammarCompiler(tokenizer).compile_grammar(rules))
    mask = xgrammar.allocate_token_bitmask(1, NUM_SYMBOLS)
    assert matcher.accept_token(SPACE)
    place, generator = grammar.start(1), torch.Generator().manual_seed(seed)
    while not matcher.is_terminated():
        matcher.fill_next_token_bitmask(mask)
        choices = torch.tensor([[bool(mask[0, 0] >> symbol & 1) for symbol in range(NUM_SYMBOLS)]])
        assert torch.equal(grammar.logit_bias(place) == 0, choices)
        symbol = torch.multinomial(choices.float(), 1, generator=generator)[0]
        assert matcher.accept_token(int(symbol))
        place = grammar.advance(place, symbol)
    assert place.prefix == grammar.DONE


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ({"num_values": 0, "num_numbers": 3}, "3 numbers with 0 values has no answers"),
        ({"num_values": 512, "num_numbers": 0}, "0 numbers with 512 values has no answers"),
        (
            {"num_values": 512, "num_numbers": 3, "fixed_width": 2},
            "512 values do not fit into 2 digits; 3 do",
        ),
    ],
)
def test_a_language_without_answers_is_refused(sizes: dict[str, int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        NumberGrammar(**sizes)
