"""Episodes of `bomb` as the tools show them."""

from collections.abc import Iterator, Mapping
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from PIL import Image, ImageDraw

from lerobot_bomb.bomb.board import BOARD
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.observation import (
    CAMERAS,
    DEFAULT_IMAGE_SIZE,
    PIXELS,
    WORKSPACE_HIGH_M,
    WORKSPACE_LOW_M,
    RenderOptions,
)
from lerobot_bomb.bomb.suite import specs_of_tasks
from lerobot_bomb.conditions import NONE
from lerobot_bomb.envs.rollout import Moment, expert_agent, make_env, run_episode
from lerobot_bomb.results.bomb import EpisodeResult
from lerobot_bomb.results.origin import NOT_RECORDED
from lerobot_bomb.viewing.episode import EXPERT, RANDOM, EnvView, Viewed
from lerobot_bomb.viewing.sheet import FONT_SIZE, GAP, INK, TILE_PAPER, font, text_tile

if TYPE_CHECKING:
    from lerobot_bomb.viewing.film import Shot

SPEC_FLAGS = ("robot", "simulator", "split", "control_mode", "fps", "target", "color", "success_tolerance_mm")
GRID_RGB, NOMINAL_RGB, PATH_RGB = (200, 185, 160), (165, 165, 165), (210, 40, 30)


class BombView(EnvView):
    """View of `bomb`: the flags are those of `record`, and the expert can act."""

    def of_flags(self, flags: Mapping[str, Any]) -> Viewed:
        task_ids, size = flags["task_ids"], flags["image_size"]
        if len(task_ids) > 1:
            raise ValueError(f"--env.task_ids={list(task_ids)} must be one task: one episode is run")
        spec = EpisodeSpec(
            flags["seed"],
            flags["task"],
            perturbations=flags["perturbations"],
            **{name: flags[name] for name in SPEC_FLAGS},
        )
        size = DEFAULT_IMAGE_SIZE if size is None else size
        options = RenderOptions(size, flags["render_preset"], flags["depth"])
        return bomb_episode(specs_of_tasks(spec, task_ids)[0], options)

    def of_record(self, record: EpisodeResult, spec: EpisodeSpec, depth: bool) -> Viewed:
        is_told = record.render_preset != NOT_RECORDED
        preset = record.render_preset if is_told else RenderOptions.preset
        return bomb_episode(spec, RenderOptions(record.image_size, preset, depth))

    def shot(self, env: gymnasium.Env, moment: Moment) -> "Shot":
        from lerobot_bomb.viewing.bomb_film import bomb_shot

        return bomb_shot(env, moment)

    def contact(self, moment: Moment) -> str:
        from lerobot_bomb.viewing.bomb_film import bomb_contact

        return bomb_contact(moment)


def bomb_episode(spec: EpisodeSpec, options: RenderOptions) -> Viewed:
    """Return an episode to be shown."""
    flags = {"task": spec.suite} | {name: getattr(spec, name) for name in ("robot", "control_mode", "fps")}
    return Viewed(
        env_type="bomb",
        spec=spec,
        group=f"{spec.suite}.{spec.condition.key}",
        fps=spec.fps,
        policies=(EXPERT, RANDOM),
        env_flags=flags | {"image_size": options.image_size, "depth": options.depth},
        make_env=partial(make_env, spec, options),
        log_at="lerobot_bomb.viewing.rerun_bomb:BombLog",
        task="".join(f"_{word}" for word in _fixed_words(spec)),
    )


def _fixed_words(spec: EpisodeSpec) -> Iterator[str]:
    if spec.task_id is not None:
        yield f"task{spec.task_id}"
    if spec.target is not None:
        yield "row{}-column{}".format(*spec.target)
    if spec.color is not None:
        yield spec.color


def bomb_tiles(condition: str, seed: int, image_size: int, changes: set[str]) -> dict[str, np.ndarray]:
    """Return tiles of the episode's start; changed dynamics are shown by the expert's path."""
    start, path_xy = _start_and_path(condition, seed, image_size, "dynamics" in changes)
    tiles = {camera: start.observation[PIXELS][camera] for camera in CAMERAS if "images" in changes}
    if "instruction" in changes:
        tiles["instruction"] = text_tile(start.instruction, image_size)
    if "dynamics" in changes:
        _, nominal_xy = _start_and_path(NONE, seed, image_size, True)
        tiles["expert's path"] = path_tile(path_xy, nominal_xy, image_size)
    return tiles


@lru_cache(maxsize=2)  # one of them the nominal episode
def _start_and_path(
    condition: str, seed: int, image_size: int, to_its_end: bool
) -> tuple[Moment, np.ndarray]:
    """Return an episode's first moment and the gripper's path (T, 2) in metres."""
    spec = EpisodeSpec(seed, perturbations=condition)
    env = make_env(spec, RenderOptions(image_size))
    moments = run_episode(env, spec, expert_agent())
    first = next(moments)
    path = [moment.state.gripper_xyz[:2] for moment in (first, *(moments if to_its_end else ()))]
    env.close()
    return first, np.array(path)


def path_tile(path_xy: np.ndarray, nominal_xy: np.ndarray, size: int) -> np.ndarray:
    """(size, size, 3) uint8: the board from above, the nominal path in grey and another in red."""
    low, high = np.array(WORKSPACE_LOW_M[:2]), np.array(WORKSPACE_HIGH_M[:2])
    pixels_per_m = size / (high - low).max()

    def pixels(points_xy: np.ndarray) -> list[tuple[float, float]]:
        x, y = ((points_xy - (low + high) / 2) * pixels_per_m).T
        return [*zip((size / 2 + x).tolist(), (size / 2 - y).tolist(), strict=True)]

    tile = Image.new("RGB", (size, size), TILE_PAPER)
    pen = ImageDraw.Draw(tile)
    last = BOARD.num_lines - 1
    for line in range(BOARD.num_lines):
        for ends in (((line, 0), (line, last)), ((0, line), (last, line))):
            pen.line(pixels(np.array([BOARD.intersection_xy(*end) for end in ends])), GRID_RGB)
    pen.line(pixels(nominal_xy), NOMINAL_RGB, 3)
    pen.line(pixels(path_xy), PATH_RGB, 1)
    pen.text((GAP, size - FONT_SIZE - GAP), f"{len(path_xy) - 1} steps", INK, font(FONT_SIZE))
    return np.asarray(tile)
