"""Plot of a grid: a histogram of each coordinate, and its cuts."""

from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw

from lerobot_bomb.viewing.sheet import FONT_SIZE, GAP, INK, LABEL_WIDTH, PAPER, TILE_PAPER, font

PLOT_WIDTH, PLOT_HEIGHT = 640, 90  # pixels
ROW_HEIGHT = PLOT_HEIGHT + FONT_SIZE + 3 * GAP  # pixels
BAR_WIDTH = 4  # pixels
TITLE_HEIGHT = 2 * FONT_SIZE + 4 * GAP  # pixels, the legend's line included
BAR_RGB, EDGE_RGB = (150, 160, 175), (210, 40, 30)


@dataclass(frozen=True)
class PlotRow:
    """Row of the plot: one coordinate."""

    label: list[str]  # lines
    values: np.ndarray  # (N,)
    edges: np.ndarray  # (E + 1,) of its bins


def draw_rows(title: str, rows: list[PlotRow]) -> np.ndarray:
    """(H, W, 3) uint8: histograms with edges, one above the other, under a title and a legend."""
    size = (LABEL_WIDTH + PLOT_WIDTH + 2 * GAP, TITLE_HEIGHT + len(rows) * ROW_HEIGHT + GAP)
    plot = Image.new("RGB", size, PAPER)
    pen = ImageDraw.Draw(plot)
    pen.text((GAP, GAP), title, INK, font(FONT_SIZE))
    x = GAP
    for rgb, text in ((BAR_RGB, "square root of how many actions"), (EDGE_RGB, "edges of the bins")):
        top = 2 * GAP + FONT_SIZE
        pen.rectangle((x, top, x + FONT_SIZE, top + FONT_SIZE), rgb)
        pen.text((x + FONT_SIZE + GAP, top), text, INK, font(FONT_SIZE))
        x += FONT_SIZE + 4 * GAP + round(pen.textlength(text, font(FONT_SIZE)))
    for i, row in enumerate(rows):
        _draw_row(pen, row, TITLE_HEIGHT + i * ROW_HEIGHT)
    return np.asarray(plot)


def edge_x(edges: np.ndarray) -> np.ndarray:
    """(E + 1,) columns of the plot, in pixels, where a coordinate's edges are drawn."""
    low, high = edges[0], edges[-1]
    return LABEL_WIDTH + np.round((edges - low) / (high - low) * (PLOT_WIDTH - 1)).astype(int)


def _draw_row(pen: ImageDraw.ImageDraw, row: PlotRow, top: int) -> None:
    low, high = float(row.edges[0]), float(row.edges[-1])
    bottom = top + PLOT_HEIGHT
    pen.multiline_text((GAP, top), "\n".join(row.label), INK, font(FONT_SIZE))
    pen.rectangle((LABEL_WIDTH, top, LABEL_WIDTH + PLOT_WIDTH - 1, bottom), TILE_PAPER)
    counts, _ = np.histogram(row.values, PLOT_WIDTH // BAR_WIDTH, (low, high))
    heights = np.sqrt(counts / max(counts.max(), 1)) * PLOT_HEIGHT  # the root, lest a peak hide the rest
    for i, height in enumerate(heights.round().astype(int).tolist()):
        if height:
            x = LABEL_WIDTH + i * BAR_WIDTH
            pen.rectangle((x, bottom - height, x + BAR_WIDTH - 1, bottom), BAR_RGB)
    for x in edge_x(row.edges).tolist():
        pen.line((x, top, x, bottom), EDGE_RGB)
    pen.text((LABEL_WIDTH, bottom + 1), f"{low:.3g}", INK, font(FONT_SIZE))
    pen.text((LABEL_WIDTH + PLOT_WIDTH, bottom + 1), f"{high:.3g}", INK, font(FONT_SIZE), anchor="ra")
