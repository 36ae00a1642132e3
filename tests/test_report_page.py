"""A page of literal tables."""

from lerobot_bomb.report.page import MAX_UNBROKEN, render
from lerobot_bomb.report.table import Cell, Section, Table


def test_a_note_that_tables_share_is_said_once_below_the_first() -> None:
    first, second = (Table(name, ["a"], [[Cell("0")]], "The same.") for name in ("first", "second"))
    other = Table("third", ["a"], [[Cell("0")]], "Another.")
    text = render("page", [Section("section", [first, second, other])])
    places = [text.index(each) for each in ("first", "The same.", "second", "third", "Another.")]
    assert places == sorted(places) and text.count("The same.") == 1


def test_text_is_on_the_left_and_long_text_is_broken_and_numbers_and_gaps_are_on_the_right() -> None:
    row = [Cell("word"), Cell("12", 12), Cell("-"), Cell("w" * (MAX_UNBROKEN + 1))]
    text = render("page", [Section("section", [Table("", ["a", "b", "c", "d"], [row])])])
    assert f'<td class="text">word</td><td>12</td><td>-</td><td class="text long">{row[-1].text}</td>' in text
