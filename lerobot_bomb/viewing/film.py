"""Filmstrip of an episode: its start, its first contact, and its end, on one image."""

import io
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field

import gymnasium
import numpy as np
from PIL import Image, ImageDraw

from lerobot_bomb.environments import env_type
from lerobot_bomb.envs.rollout import Moment, run_episode
from lerobot_bomb.results.record import Record
from lerobot_bomb.tables import shorten
from lerobot_bomb.viewing.episode import EnvView, Viewed, ViewedRun
from lerobot_bomb.viewing.sheet import Sheet, caption, font
from lerobot_bomb.viewing.video import packed, unpacked

TILE_SIZE = 260  # pixels
JPEG_QUALITY = 80  # a page with 40 filmstrips is still sent as one file
LABEL_WIDTH = 80  # pixels
MAX_TITLE = 70  # characters
MARK_RGB, EDGE_RGB = (255, 255, 255), (0, 0, 0)  # white with a black edge is seen on all that is drawn
RING_RGB = (255, 0, 190)  # pink: neither board nor stones nor gripper have it, also for the colour-blind
MARK_SIZE, RING_WIDTH = 14, 3  # pixels

type Watch = Callable[[gymnasium.Env, Moment], None]


@dataclass(frozen=True)
class Marks:
    """Marks on an image, at pixels (x, y)."""

    words: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # "row 2" -> its middle
    outlines: Sequence[Sequence[tuple[float, float]]] = ()  # closed


@dataclass(frozen=True)
class Shot:
    """Images of a moment, by the row of the filmstrip that they stand in, and what is marked on them."""

    images: Mapping[str, np.ndarray]  # (H, W, 3) uint8
    marks: Mapping[str, Marks] = field(default_factory=dict)


class Film:
    """Moments of an episode as it runs, and the filmstrip of some of them."""

    def __init__(self, view: EnvView, env: gymnasium.Env) -> None:
        self._view, self._env = view, env
        self._shots: list[Shot] = []  # their images packed: an episode may have hundreds
        self._contact: tuple[int, str] | None = None  # step and name of the first contact with something

    def add(self, moment: Moment) -> None:
        """Add a moment while the environment is in it."""
        shot: Shot = self._view.shot(self._env, moment)
        images = {name: packed(image) for name, image in shot.images.items()}
        self._shots.append(Shot(images, shot.marks))
        contact = self._view.contact(moment)
        if contact and (self._contact is None or contact != self._contact[1]):
            self._contact = moment.step, contact

    @property
    def moments(self) -> dict[str, int]:
        """Steps that are shown, by the name of their column."""
        last = len(self._shots) - 1
        step, name = self._contact or (last // 2, "middle")
        return {"start": 0, f"{name}, step {step}": step, f"end, step {last}": last}

    def draw(self, heading: str, instruction: str, outcome: str) -> np.ndarray:
        """Draw the filmstrip, (H, W, 3) uint8."""
        rows: dict[str, list[np.ndarray]] = {}
        for step in self.moments.values():
            shot = self._shots[step]
            for row, image in shot.images.items():
                tile = drawn(unpacked(image), shot.marks.get(row, Marks()))
                rows.setdefault(row, []).append(tile)
        sheet = Sheet(heading, list(self.moments), images=rows, label_width=LABEL_WIDTH).draw()
        return np.vstack([sheet, caption(instruction, outcome, sheet.shape[1])])


def run_filmed(
    run: ViewedRun, watch: Watch | None = None, with_film: bool = True
) -> tuple[Record, np.ndarray | None]:
    """Run an episode; return its result, and its filmstrip, (H, W, 3) uint8, if one is to be drawn.

    ``watch`` gets each moment while the environment is in it.
    """
    viewed = run.viewed
    with closing(viewed.make_env()) as env, run.make_agent(env) as agent:
        film = Film(env_type(viewed.env_type).view, env) if with_film else None
        for moment in run_episode(env, viewed.spec, agent):
            if watch is not None:
                watch(env, moment)
            if film is not None:
                film.add(moment)
        result: Record = env.get_wrapper_attr("episode_result")()
    return result, None if film is None else draw_film(film, viewed, result)


def draw_film(film: Film, viewed: Viewed, result: Record) -> np.ndarray:
    """Draw the filmstrip of an episode that has ended, with condition, seed and outcome in words."""
    heading = f"{shorten(viewed.title, MAX_TITLE)}: {result.failure or 'success'}"
    return film.draw(heading, getattr(result, "instruction", ""), viewed.log.describe(result))


def as_jpeg(film: np.ndarray) -> bytes:
    """Encode a filmstrip, (H, W, 3) uint8."""
    file = io.BytesIO()
    Image.fromarray(film).save(file, format="jpeg", quality=JPEG_QUALITY, subsampling=0, optimize=True)
    return file.getvalue()


def drawn(image: np.ndarray, marks: Marks) -> np.ndarray:
    """(H, W, 3) uint8 -> (TILE_SIZE, TILE_SIZE, 3) uint8, with the marks."""
    height, width = image.shape[:2]
    tile = Image.fromarray(image).resize((TILE_SIZE, TILE_SIZE), Image.Resampling.LANCZOS)
    pen = ImageDraw.Draw(tile)

    def at(xy: tuple[float, float]) -> tuple[float, float]:
        return xy[0] * TILE_SIZE / width, xy[1] * TILE_SIZE / height

    for outline in marks.outlines:
        points = [at(xy) for xy in (*outline, *outline[:2])]
        pen.line(points, EDGE_RGB, RING_WIDTH + 2)
        pen.line(points, RING_RGB, RING_WIDTH)
    for word, xy in marks.words.items():
        pen.text(at(xy), word, MARK_RGB, font(MARK_SIZE), anchor="mm", stroke_width=2, stroke_fill=EDGE_RGB)
    return np.asarray(tile)
