"""A page of literal tables."""

import re

from lerobot_bomb.report.chart import INK, Chart, chart_text, chart_texts
from lerobot_bomb.report.dots import Block, Dot, DotColumn, dot_chart
from lerobot_bomb.report.explanation import verdict_section
from lerobot_bomb.report.page import MAX_ROWS, MAX_UNBROKEN, render
from lerobot_bomb.report.table import Cell, Section, Statement, Table
from lerobot_bomb.tables import MAX_NAME, shorten, shorten_all

HOSTILE = "</svg><script>$x$ \n&amp;" + "n" * 5000


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


def test_a_section_reads_from_sentences_over_charts_to_folded_tables() -> None:
    numbers = Table("numbers", ["a"], [[Cell("1", 1)]])
    chart = Chart("chart", "<svg></svg>", [numbers], "Its note.")
    section = Section(
        "section", [Table("table", ["a"], [])], statements=[Statement("A", "is <better>.")], charts=[chart],
        is_folded=True,
    )  # fmt: skip
    text = render("page", [section])
    parts = [
        "<b>A</b> is &lt;better&gt;.",
        "<figcaption>chart",
        "<svg>",
        "Its note.",
        "<details>",
        "<h3>numbers</h3>",
        "<h3>table</h3>",
    ]
    places = [text.index(each) for each in parts]
    assert places == sorted(places) and text.count("<details>") == text.count("</details>") == 2
    found = section.as_json()
    assert found["statements"] == ["A is <better>."] and found["charts"][0]["tables"][0]["rows"] == [[1]]


def test_a_long_table_is_cut_and_says_so() -> None:
    table = Table("", ["a"], [[Cell(str(number), number)] for number in range(MAX_ROWS + 1234)])
    text = render("page", [Section("section", [table])])
    assert text.count("<tr>") == MAX_ROWS + 1 and "1,234 more rows are in the JSON file" in text
    assert len(table.as_json()["rows"]) == MAX_ROWS + 1234


def test_names_are_shortened_in_their_middle() -> None:
    assert shorten("a" * MAX_NAME) == "a" * MAX_NAME
    assert shorten("begin" + "x" * 100 + "end", 10) == "begin…xend"
    assert len(shorten("x" * 5000)) == MAX_NAME
    assert chart_text("a$b\nc") == r"a\$b\nc"


def test_names_that_differ_in_the_middle_stay_apart() -> None:
    names = [f"act pusht_act_lr{rate}_wd4_batch64_steps100k_final" for rate in ("0.1", "0.01", "0.011")]
    short = shorten_all([*names, "act", names[0]])
    assert len({*short.values()}) == 4 and max(map(len, short.values())) <= MAX_NAME
    assert short["act"] == "act" and short[names[0]] == "act pusht_ac…1_wd4_batch…s100k_final"
    assert chart_texts(names) == [short[name] for name in names]


def test_hostile_text_is_text_on_the_page_and_in_a_chart() -> None:
    dots = DotColumn("label", {0: [Dot(1.0, 0.5, 2.0)], 1: [None]})
    svg = dot_chart(HOSTILE, [HOSTILE, "b"], [Block(HOSTILE, [HOSTILE], [dots])])
    chart = Chart(HOSTILE, svg, [Table(HOSTILE, [HOSTILE], [[Cell(HOSTILE)]])])
    text = render(HOSTILE, [Section("s", [], statements=[Statement(HOSTILE, "is.")], charts=[chart])])
    assert "<script" not in text and text.count("</svg>") == text.count("<svg") == 1
    assert "n" * 500 not in re.sub(r'title="[^"]*"|<title>.*?</title>', "", text, flags=re.DOTALL)


def test_a_chart_takes_the_page_s_colour_and_is_the_same_each_time() -> None:
    block = Block("b", ["r"], [DotColumn("l", {0: [Dot(1.0, None, None, is_filled=False)]}, (0, 2), line=1)])
    svg = dot_chart("title", ["s"], [block])
    assert svg == dot_chart("title", ["s"], [block])
    assert svg.startswith('<svg role="img"') and "<title>title</title>" in svg
    assert "currentColor" in svg and INK not in svg and "<text" in svg and "http" not in svg
    assert "<style" not in svg and "<g id=" not in svg


def test_a_verdict_and_an_instruction_are_text() -> None:
    page = render(HOSTILE, [verdict_section([HOSTILE, HOSTILE], HOSTILE)])
    assert "<script" not in page and page.count("&lt;script&gt;") >= 4
