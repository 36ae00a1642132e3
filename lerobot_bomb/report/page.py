"""A report as one HTML file: no network, no script, readable on a phone, in light and dark."""

import base64
from collections.abc import Sequence
from html import escape

from lerobot_bomb.report.chart import Chart
from lerobot_bomb.report.table import Cell, Section, Statement, Table
from lerobot_bomb.tables import shorten

# one hue in different strengths, which reads the same for the colour-blind
SHADE = "background:rgba(0,114,178,{:.2f})"
MAX_STRENGTH = 0.55  # text stays readable on it, black or white
MAX_UNBROKEN = 24  # characters of a cell that stay in one line, even where the table is too wide
MAX_TEXT = 240  # characters of a name or cell that are shown; the rest is shown under the pointer
MAX_SUBJECT = 60  # characters of the subject of a sentence
MAX_HOVER = 6000  # characters shown under the pointer
MAX_ROWS = 200  # of a table that the page shows; the files beside it have all
# the gradients of .wide are a shadow at each edge behind which there is more to scroll to
STYLE = """
:root{color-scheme:light dark}
body{background:Canvas;color:CanvasText}
body{font:15px/1.5 system-ui,sans-serif;max-width:75rem;margin:0 auto;padding:1rem}
h1{font-size:1.5rem}h2{font-size:1.2rem;margin-top:2.5rem;border-bottom:1px solid #8888}h3{font-size:1rem}
.wide{overflow-x:auto;background:
linear-gradient(90deg,Canvas 40%,transparent) 0 0/2rem 100% no-repeat local,
linear-gradient(270deg,Canvas 40%,transparent) 100% 0/2rem 100% no-repeat local,
linear-gradient(90deg,#888a,transparent) 0 0/.8rem 100% no-repeat scroll,
linear-gradient(270deg,#888a,transparent) 100% 0/.8rem 100% no-repeat scroll}
table{border-collapse:separate;border-spacing:0;font-variant-numeric:tabular-nums}
th,td{padding:.25rem .6rem;border-bottom:1px solid #8884;text-align:right}
td{white-space:nowrap}th{vertical-align:bottom}
th:first-child,td:first-child{text-align:left;position:sticky;left:0;background:Canvas}
th.text,td.text{text-align:left}
td.long{white-space:normal;overflow-wrap:anywhere;min-width:9rem}
p.note{opacity:.75;max-width:60rem;font-size:.9rem}
figure{margin:1rem 0}figure img{image-rendering:pixelated;margin-right:.3rem}
figcaption{font-weight:600;font-size:1rem}
figure svg{display:block;max-width:100%;height:auto}
figure svg *{stroke-linejoin:round;stroke-linecap:butt}
p.statement{max-width:60rem;margin:.5rem 0}
h1,h2,h3,b,summary{overflow-wrap:anywhere}
details{margin:.5rem 0}summary{cursor:pointer;opacity:.85}
pre{white-space:pre-wrap;overflow-wrap:anywhere;font-size:.85rem}
nav a{display:inline-block;margin-right:1rem}
video{display:block;width:20rem;max-width:75vw}
"""


def render(title: str, sections: Sequence[Section]) -> str:
    """Render the whole page as HTML."""
    links = "".join(f'<a href="#{_anchor(section)}">{escape(section.title)}</a>' for section in sections)
    body = "\n".join(_section(section) for section in sections)
    heading = f"<h1>{_shown(title)}</h1>"
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(shorten(title, MAX_TEXT))}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n"
        f"<header>{heading}</header>\n<nav>{links}</nav>\n<main>\n{body}\n</main>\n</body>\n</html>\n"
    )


def _anchor(section: Section) -> str:
    return section.title.lower().replace(" ", "-")


def _section(section: Section) -> str:
    heading = f'<h2 id="{_anchor(section)}">{escape(section.title)}</h2>'
    parts = [heading, *map(_statement, section.statements), section.figures, *map(_chart, section.charts)]
    below = _tables(section.tables)
    below += [f"<pre>{escape(chr(10).join(section.lines))}</pre>"] if section.lines else []
    parts += [_folded(section.title, below)] if section.is_folded else below
    return "\n".join(part for part in parts if part)


def _statement(statement: Statement) -> str:
    return (
        f'<p class="statement"><b>{_shown(statement.subject, MAX_SUBJECT)}</b> {escape(statement.text)}</p>'
    )


def _chart(chart: Chart) -> str:
    caption = f"<figcaption>{_shown(chart.title)}</figcaption>"
    note = f'<p class="note">{escape(chart.note)}</p>' if chart.note else ""
    numbers = _folded("The numbers", _tables(chart.tables)) if chart.tables else ""
    return f'<figure>{caption}\n<div class="wide" tabindex="0">{chart.svg}</div>{note}{numbers}</figure>'


def _folded(title: str, parts: list[str]) -> str:
    return f"<details><summary>{escape(title)}</summary>\n{chr(10).join(parts)}\n</details>"


def _tables(tables: Sequence[Table]) -> list[str]:
    """Render tables, each note below the first that has it."""
    parts, said = [], set[str]()
    for table in tables:
        parts.append(_table(table, "" if table.note in said else table.note))
        said.add(table.note)
    return parts


def _shown(text: str, most: int = MAX_TEXT) -> str:
    """Escape a text; of a very long one, show the ends, and the rest under the pointer."""
    if len(text) <= most:
        return escape(text)
    return f'<span title="{escape(text[:MAX_HOVER])}">{escape(shorten(text, most))}</span>'


def _table(table: Table, note: str) -> str:
    title = f"<h3>{_shown(table.title)}</h3>\n" if table.title else ""
    kinds = [["text"] if _is_text(table, column) else [] for column in range(len(table.header))]
    names = zip(table.header, kinds, strict=True)
    head = "".join(f'<th scope="col"{_class(kind)}>{_shown(name)}</th>' for name, kind in names)
    rows = "\n".join(f"<tr>{''.join(map(_cell, row, kinds))}</tr>" for row in table.rows[:MAX_ROWS])
    left = len(table.rows) - MAX_ROWS
    notes = [note] if note else []
    notes += [f"{left:,} more rows are in the JSON file beside this page."] if left > 0 else []
    below = "".join(f'\n<p class="note">{escape(each)}</p>' for each in notes)
    grid = f"<table>\n<thead><tr>{head}</tr></thead>\n<tbody>\n{rows}\n</tbody>\n</table>"
    return f'{title}<div class="wide" tabindex="0">{grid}</div>{below}'


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
    return f"<td{_class(names)}{style}>{video}{_shown(cell.text)}</td>"


def film_figure(film: bytes, told: str, below: str = "") -> str:
    """Return a filmstrip, a JPEG; `told`: what it shows, in words; `below`: HTML."""
    source = f"data:image/jpeg;base64,{base64.b64encode(film).decode()}"
    return (
        f'<figure><img src="{source}" alt="Filmstrip: {escape(told)}" loading="lazy" '
        f'style="max-width:100%;image-rendering:auto">{below}</figure>'
    )
