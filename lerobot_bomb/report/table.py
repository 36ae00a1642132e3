"""Parts of a page: sections of tables of cells."""

from dataclasses import dataclass, field
from typing import Any


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
class Section:
    """Tables that answer one question."""

    title: str
    tables: list[Table]
    lines: list[str] = field(default_factory=list)  # of text below
    figures: str = ""  # HTML, above the tables

    def as_json(self) -> dict[str, Any]:
        """Return the section as JSON, without figures."""
        return {"title": self.title, "tables": [each.as_json() for each in self.tables], "lines": self.lines}
