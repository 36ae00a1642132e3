"""A report as one HTML file: no network, no script, readable on a phone, in light and dark."""

from collections.abc import Sequence
from html import escape

from lerobot_bomb.report.table import Cell, Section, Table

# one hue in different strengths, which reads the same for the colour-blind
SHADE = "background:rgba(0,114,178,{:.2f})"
MAX_STRENGTH = 0.55  # text stays readable on it, black or white
MAX_UNBROKEN = 24  # characters of a cell that stay in one line, even where the table is too wide
STYLE = """
:root{color-scheme:light dark}
body{font:15px/1.5 system-ui,sans-serif;max-width:75rem;margin:0 auto;padding:1rem}
h1{font-size:1.5rem}h2{font-size:1.2rem;margin-top:2.5rem;border-bottom:1px solid #8888}h3{font-size:1rem}
.wide{overflow-x:auto}
table{border-collapse:separate;border-spacing:0;font-variant-numeric:tabular-nums}
th,td{padding:.25rem .6rem;border-bottom:1px solid #8884;text-align:right}
td{white-space:nowrap}th{vertical-align:bottom}
th:first-child,td:first-child{text-align:left;position:sticky;left:0;background:Canvas}
th.text,td.text{text-align:left}
td.long{white-space:normal;overflow-wrap:anywhere;min-width:9rem}
p.note{opacity:.75;max-width:60rem;font-size:.9rem}
figure{margin:1rem 0}figure img{image-rendering:pixelated;margin-right:.3rem}
pre{white-space:pre-wrap;overflow-wrap:anywhere;font-size:.85rem}
nav a{display:inline-block;margin-right:1rem}
video{display:block;width:20rem;max-width:75vw}
"""


def render(title: str, sections: Sequence[Section]) -> str:
    """Render the whole page as HTML."""
    links = "".join(f'<a href="#{_anchor(section)}">{escape(section.title)}</a>' for section in sections)
    body = "\n".join(_section(section) for section in sections)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n"
        f"<h1>{escape(title)}</h1>\n<nav>{links}</nav>\n{body}\n</body>\n</html>\n"
    )


def _anchor(section: Section) -> str:
    return section.title.lower().replace(" ", "-")


def _section(section: Section) -> str:
    heading = f'<h2 id="{_anchor(section)}">{escape(section.title)}</h2>'
    parts = [heading, section.figures]
    said: set[str] = set()  # notes, each below the first table that has it
    for table in section.tables:
        parts.append(_table(table, "" if table.note in said else table.note))
        said.add(table.note)
    parts += [f"<pre>{escape(chr(10).join(section.lines))}</pre>"] if section.lines else []
    return "\n".join(parts)


def _table(table: Table, note: str) -> str:
    title = f"<h3>{escape(table.title)}</h3>\n" if table.title else ""
    kinds = [["text"] if _is_text(table, column) else [] for column in range(len(table.header))]
    names = zip(table.header, kinds, strict=True)
    head = "".join(f'<th scope="col"{_class(kind)}>{escape(name)}</th>' for name, kind in names)
    rows = "\n".join(f"<tr>{''.join(map(_cell, row, kinds))}</tr>" for row in table.rows)
    below = f'\n<p class="note">{escape(note)}</p>' if note else ""
    grid = f"<table>\n<thead><tr>{head}</tr></thead>\n<tbody>\n{rows}\n</tbody>\n</table>"
    return f'{title}<div class="wide">{grid}</div>{below}'


def _is_text(table: Table, column: int) -> bool:
    """Return True if a column has words and no numbers."""
    cells = [row[column] for row in table.rows]
    has_numbers = any(isinstance(cell.value, int | float | dict) for cell in cells)
    return not has_numbers and any(cell.text not in ("", "-") for cell in cells)


def _class(names: list[str]) -> str:
    return f' class="{" ".join(names)}"' if names else ""


def _cell(cell: Cell, kind: list[str]) -> str:
    style = "" if cell.shade is None else f' style="{SHADE.format(cell.shade * MAX_STRENGTH)}"'
    video = (
        "" if cell.video is None else f'<video controls preload="none" src="{escape(cell.video)}"></video>'
    )
    names = [*kind, "long"] if len(cell.text) > MAX_UNBROKEN else kind
    return f"<td{_class(names)}{style}>{video}{escape(cell.text)}</td>"
