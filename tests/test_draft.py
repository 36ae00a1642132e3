import pytest
import torch

from lerobot_bomb.actions.text import END, SYMBOL_TEXTS
from lerobot_bomb.decoding.draft import KnownSymbols, LinearDraft
from lerobot_bomb.decoding.grammar import NumberGrammar, Place


def rows_of(grammar: NumberGrammar, *texts: str) -> tuple[torch.Tensor, Place]:
    """The complete numbers of rows that are written so far, after the first space, and where they stand."""
    numbers = torch.zeros(len(texts), grammar.num_numbers, dtype=torch.int64)
    places = []
    for row, text in zip(numbers, texts, strict=True):
        *complete, _ = text.split(" ")
        row[: len(complete)] = torch.tensor([int(number) for number in complete])
        place = grammar.start(1)
        for symbol in map(SYMBOL_TEXTS.index, text):
            place = grammar.advance(place, torch.tensor([symbol]))
        places.append(place)
    return numbers, Place(
        torch.cat([place.prefix for place in places]), torch.cat([place.number for place in places])
    )


def said(guess: torch.Tensor) -> list[str]:
    return [
        "".join("#" if symbol == END else SYMBOL_TEXTS[symbol] for symbol in row) for row in guess.tolist()
    ]


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
        ("200 20 0", " 20 0 20"),  # nothing goes on after a leading 0
        ("100 20 10", "0 20 100"),
    ],
)
def test_the_line_is_drawn_through_the_last_two_steps(written: str, guessed: str) -> None:
    grammar = NumberGrammar(512, 6)
    (guess,) = said(LinearDraft(grammar, 2)(*rows_of(grammar, written)))
    assert guess.startswith(guessed)


@pytest.mark.parametrize(
    ("written", "guessed"),
    [
        ("", "255 255 255 "),  # nothing to go by, before the actions and in the first of them
        ("400", " 255 255 255 "),
        ("400 10 20", "9 10 209"),
        ("400 10 20 13", " 20 16 "),  # as if the actions stood alone
        ("400 10 20 30 40 50", " 60###"),
    ],
)
def test_numbers_before_the_actions_are_on_no_line(written: str, guessed: str) -> None:
    grammar = NumberGrammar(512, 7)
    (guess,) = said(LinearDraft(grammar, 2, num_before=1)(*rows_of(grammar, written)))
    assert guess.startswith(guessed)


def test_rows_are_guessed_for_themselves() -> None:
    grammar = NumberGrammar(999, 4, fixed_width=3)
    guesses = said(LinearDraft(grammar, 1)(*rows_of(grammar, "010 02", "500 400 3", "001 002 003 0")))
    assert guesses == ["0 030 040" + 15 * "#", "00 200" + 18 * "#", "04" + 22 * "#"]


def test_known_symbols_are_those_after_numbers_that_cannot_go_on() -> None:
    grammar = NumberGrammar(512, 2)
    guess = KnownSymbols(grammar)
    assert guess(*rows_of(grammar, "5", "51")).shape == (2, 0)
    assert said(guess(*rows_of(grammar, "52", "1 60"))) == [" ", "#"]
