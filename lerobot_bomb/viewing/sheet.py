"""Contact sheets: rows of small images and of numbers under named columns."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from PIL import Image, ImageDraw, ImageFont

LABEL_WIDTH = 150  # pixels, of the column at the left
GAP = 4  # pixels between tiles
FONT_SIZE, TITLE_SIZE = 12, 16  # pixels
MIN_FONT_SIZE = 7  # pixels, of an instruction that is long for its tile
LINE_HEIGHT, TITLE_HEIGHT = 18, 30  # pixels
BAR_HEIGHT = 24  # pixels, even as videos need it
PAPER, INK = (255, 255, 255), (20, 20, 20)
TILE_PAPER = (244, 244, 240)


@dataclass(frozen=True)
class Sheet:
    """Contact sheet; every row has an entry per column."""

    title: str
    columns: list[str]
    texts: dict[str, list[str]] = field(default_factory=dict)  # row label -> words under each column
    images: dict[str, list[np.ndarray]] = field(default_factory=dict)  # -> (H, W, 3) uint8 tiles, all alike
    label_width: int = LABEL_WIDTH  # pixels

    def draw(self) -> np.ndarray:
        """Draw (H, W, 3) uint8 with the unchanged tiles, each at its `tile_origin`."""
        tile_height, tile_width = self._tile_shape
        width = self.label_width + len(self.columns) * (tile_width + GAP)
        height = self._top + len(self.images) * (tile_height + GAP)
        sheet = Image.new("RGB", (width, height), PAPER)
        pen = ImageDraw.Draw(sheet)
        pen.text((GAP, GAP), self.title, INK, font(TITLE_SIZE))
        for row, (label, words) in enumerate([("", self.columns), *self.texts.items()]):
            y = TITLE_HEIGHT + row * LINE_HEIGHT
            pen.text((GAP, y), label, INK, font(FONT_SIZE))
            for column, word in enumerate(words):
                pen.text(
                    (self.label_width + column * (tile_width + GAP) + GAP, y), word, INK, font(FONT_SIZE)
                )
        for row, (label, tiles) in enumerate(self.images.items()):
            pen.text((GAP, self.tile_origin(row, 0)[0] + GAP), label, INK, font(FONT_SIZE))
            for column, tile in enumerate(tiles):
                y, x = self.tile_origin(row, column)
                sheet.paste(Image.fromarray(tile), (x, y))
        return np.asarray(sheet)

    def tile_origin(self, row: int, column: int) -> tuple[int, int]:
        """(y, x) in pixels of a tile's upper left corner."""
        height, width = self._tile_shape
        return self._top + row * (height + GAP), self.label_width + column * (width + GAP)

    @property
    def _tile_shape(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        return next(iter(self.images.values()))[0].shape[:2]

    @property
    def _top(self) -> int:
        return TITLE_HEIGHT + (1 + len(self.texts)) * LINE_HEIGHT


def text_tile(text: str, size: int) -> np.ndarray:
    """(size, size, 3) uint8: an instruction, broken into lines, in smaller type if it is long.

    What does not fit at MIN_FONT_SIZE is cut off.
    """
    tile = Image.new("RGB", (size, size), TILE_PAPER)
    pen = ImageDraw.Draw(tile)
    lines, face = _fitted(
        text,
        size - 2 * GAP,
        lambda lines, face: pen.multiline_textbbox((GAP, GAP), lines, face, spacing=2)[3] <= size,
    )
    pen.multiline_text((GAP, GAP), lines, INK, face, spacing=2)
    return np.asarray(tile)


def caption(text: str, last_line: str, width: int) -> np.ndarray:
    """(H, width, 3) uint8: a text in at most two lines, smaller if it is long, and a line below."""
    bar = Image.new("RGB", (width, GAP + 3 * LINE_HEIGHT), TILE_PAPER)
    pen = ImageDraw.Draw(bar)
    lines, face = _fitted(text, width - 2 * GAP, lambda lines, _: lines.count("\n") < 2)
    pen.multiline_text((GAP, GAP), lines, INK, face, spacing=2)
    pen.text((GAP, GAP + 2 * LINE_HEIGHT), last_line, INK, font(FONT_SIZE))
    return np.asarray(bar)


def title_bar(text: str, width: int) -> np.ndarray:
    """(H, width, 3) uint8: a text in one line, smaller if it is long, with an ellipsis if it is too long."""
    room = width - 2 * GAP
    sizes = range(FONT_SIZE, MIN_FONT_SIZE - 1, -1)
    face = next((font(size) for size in sizes if font(size).getlength(text) <= room), font(MIN_FONT_SIZE))
    if face.getlength(text) > room:
        text = text[:width]
        while text and face.getlength(f"{text}…") > room:
            text = text[:-1]
        text = f"{text}…"
    bar = Image.new("RGB", (width, BAR_HEIGHT), TILE_PAPER)
    ImageDraw.Draw(bar).text((GAP, GAP), text, INK, face)
    return np.asarray(bar)


def _fitted(
    text: str, width: int, fits: Callable[[str, ImageFont.FreeTypeFont], bool]
) -> tuple[str, ImageFont.FreeTypeFont]:
    """Break a text into lines of so many pixels at most, in the largest type that fits, or the smallest."""
    for font_size in range(FONT_SIZE, MIN_FONT_SIZE - 1, -1):
        face = font(font_size)
        lines = _broken(text, face, width)
        if fits(lines, face):
            break
    return lines, face


def _broken(text: str, face: ImageFont.FreeTypeFont, width: int) -> str:
    """Break a text into lines of so many pixels at most."""
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".strip()
        lines = [*lines[:-1], longer] if face.getlength(longer) <= width else [*lines, word]
    return "\n".join(lines)


@cache
def font(size: int) -> ImageFont.FreeTypeFont:
    """Pillow's own typeface, which needs no file of the system."""
    return ImageFont.load_default(size)  # pyright: ignore[reportReturnType]  a bitmap without FreeType only
