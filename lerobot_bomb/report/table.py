"""Parts of a page: sections of sentences, charts, and tables of cells."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lerobot_bomb.report.chart import Chart

MAX_TOLD = 6  # policies that have a sentence


@dataclass(frozen=True)
class Cell:
    """Cell of a table: its text, its value as a number or text, and how strongly it is coloured."""

    text: str
    value: Any = None
    shade: float | None = None  # 0..1
    video: str | None = None  # link from the page


@dataclass(frozen=True)
class Table:
    """Rows under columns; the first column names the row."""

    title: str
    header: list[str]
    rows: list[list[Cell]]
    note: str = ""

    def as_json(self) -> dict[str, Any]:
        """Return the table as JSON, numbers in place of their text."""
        rows = [[cell.text if cell.value is None else cell.value for cell in row] for row in self.rows]
        return {"title": self.title, "note": self.note, "header": self.header, "rows": rows}


@dataclass(frozen=True)
class Statement:
    """Sentence about a subject, which stands out."""

    subject: str
    text: str

    def __str__(self) -> str:
        return f"{self.subject} {self.text}"


@dataclass(frozen=True)
class Section:
    """Sentences, charts and tables that answer one question."""

    title: str
    tables: list[Table]
    lines: list[str] = field(default_factory=list)  # of text below
    figures: str = ""  # HTML, above the tables
    statements: list[Statement] = field(default_factory=list)  # above all else
    charts: list["Chart"] = field(default_factory=list)
    is_folded: bool = False  # tables and lines open on a click

    def as_json(self) -> dict[str, Any]:
        """Return the section as JSON: of charts their numbers."""
        return {
            "title": self.title,
            "statements": [str(each) for each in self.statements],
            "charts": [each.as_json() for each in self.charts],
            "tables": [each.as_json() for each in self.tables],
            "lines": self.lines,
        }
