"""Charts as SVG inside a page: drawn by matplotlib, text as text, in the colours of the page."""

import io
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import TYPE_CHECKING, Any

from lerobot_bomb.report.table import Table
from lerobot_bomb.tables import printable, shorten_all

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK = "#010203"  # of text and axes; the page's own colour takes its place
# distinct for the colour-blind, in light and dark (Okabe and Ito)
COLORS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#999999")
MARKERS = "osD^vPX"
MAX_SERIES = 6  # that a chart can show side by side
MAX_BARS = 80  # below each other
WIDTH = 9.6  # inches: what a page shows without scrolling
NAMESPACES = 'xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink"'
PAPER = "color:#222;background:#fff;"
STYLE = {
    "svg.fonttype": "none",
    "font.size": 9,
    "font.sans-serif": ["DejaVu Sans"],  # comes with matplotlib; wider than what the page uses
    "axes.titlesize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    **dict.fromkeys(("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color"), INK),
}


@dataclass(frozen=True)
class Chart:
    """Picture of numbers, with the tables that hold them."""

    title: str
    svg: str
    tables: list[Table] = field(default_factory=list)  # folded away below
    note: str = ""

    def as_json(self) -> dict[str, Any]:
        """Return the chart's numbers as JSON."""
        return {"title": self.title, "note": self.note, "tables": [each.as_json() for each in self.tables]}


def draw(title: str, size: tuple[float, float], paint: Callable[["Figure"], None]) -> str:
    """Return what `paint` draws on a figure of (width, height) inches as SVG; the same each time."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context():
        matplotlib.rcdefaults()  # whatever the user's own settings are
        style: Any = STYLE | {"svg.hashsalt": title}
        matplotlib.rcParams.update(style)
        figure = Figure(figsize=size, layout="constrained")
        paint(figure)
        text = io.StringIO()
        metadata = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        figure.savefig(text, format="svg", transparent=True, metadata=metadata)
    return _inline(text.getvalue(), title, size)


def _inline(svg: str, title: str, size: tuple[float, float]) -> str:
    """Return the `svg` element for a page: named, and in the page's colour and font."""
    body = svg[svg.index("<svg") :]
    body = body[body.index(">") + 1 :]
    body = re.sub(r"<metadata>.*?</metadata>\s*", "", body, flags=re.DOTALL)
    body = re.sub(r"<style.*?</style>\s*", "", body, flags=re.DOTALL).replace("xlink:href", "href")
    body = re.sub(r'<g id="[^"]*"', "<g", body)  # the same in every figure
    body = re.sub(r"\n\s*", "\n", body.replace("'DejaVu Sans'", "system-ui")).replace(INK, "currentColor")
    width, height = (72 * each for each in size)
    pixels = round(96 * size[0])
    return (
        f'<svg role="img" viewBox="0 0 {width:g} {height:g}" '
        f'style="width:{pixels}px;min-width:min(46rem,{pixels}px)"><title>{escape(title)}</title>{body}'
    )


def standalone(svg: str) -> str:
    """Return a chart's SVG as a file of its own, on white: a page's own colours do not reach an image."""
    named = svg.replace("<svg ", f"<svg {NAMESPACES} ", 1)
    return named.replace('style="', f'style="{PAPER}', 1)


def chart_text(name: str) -> str:
    """Return a name for matplotlib, which takes `$` for mathematics; shortened."""
    return chart_texts([name])[0]


def chart_texts(names: Sequence[str]) -> list[str]:
    """Return the names of a chart as `chart_text`; those that differ still do."""
    shown = [*map(printable, names)]
    short = shorten_all(shown)
    return [short[name].replace("$", r"\$") for name in shown]


def tidy(axes: "Axes", grid: str = "x") -> None:
    """Draw a faint grid along one axis, below the data."""
    axes.grid(axis=grid, color=INK, alpha=0.15, linewidth=0.6)  # pyright: ignore[reportArgumentType]
    axes.set_axisbelow(True)
