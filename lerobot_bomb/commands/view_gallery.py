"""``lerobot-bomb view gallery``: what each perturbation axis does, or a suite's tasks, on sheets."""

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw
from tqdm import tqdm

from lerobot_bomb.bomb.board import BOARD
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.observation import CAMERAS, PIXELS, WORKSPACE_HIGH_M, WORKSPACE_LOW_M, RenderOptions
from lerobot_bomb.bomb.perturbations import AXES, NUISANCES
from lerobot_bomb.bomb.suite import find_suite, specs_of_tasks
from lerobot_bomb.bomb.suites import SUITES
from lerobot_bomb.commands.arguments import add_env_flag, parse_numbers, path_flag
from lerobot_bomb.conditions import ALL, MAX_LEVEL, NONE, Axis, nuisances_of
from lerobot_bomb.envs.rollout import expert_agent, make_env, make_libero_env, make_pusht_env, play
from lerobot_bomb.files import written_whole
from lerobot_bomb.flags import one_of, reworded
from lerobot_bomb.libero.assets import prepare_libero
from lerobot_bomb.libero.episode import LiberoSpec
from lerobot_bomb.libero.perturbations import LIBERO_AXES
from lerobot_bomb.pusht.episode import PushTSpec, check_installed
from lerobot_bomb.pusht.perturbations import PUSHT_AXES
from lerobot_bomb.viewing.perturbations_page import write_page
from lerobot_bomb.viewing.sheet import FONT_SIZE, GAP, INK, TILE_PAPER, Sheet, font, text_tile

SHEETS = (*AXES, ALL)
AXES_OF = {"bomb": AXES, "bomb_pusht": PUSHT_AXES, "bomb_libero": LIBERO_AXES}  # by --env.type
PUSHED_STEPS = 6  # through the block, for what `dynamics` does
LIBERO_TASK = "libero_spatial"  # whose first task the sheets show
LIBERO_ACTIONS = [[0.5, 0.0, -0.8, 0.0, 0.0, 0.0, -1.0]] * 12  # forwards and down
LEVELS = range(MAX_LEVEL + 1)
COLUMNS = ["nominal", *(f"level {level}" for level in LEVELS[1:])]
DEFAULT_SEEDS = (2, 3)
DEFAULT_TILE_SIZE = 144  # pixels
DEFAULT_FOLDER = Path("outputs/gallery")
JPEG_QUALITY = 88
# (condition, seed, pixels of a side, what it changes) -> {name: (S, S, 3) uint8}
type TilesOf = Callable[[str, int, int, set[str]], dict[str, np.ndarray]]
GRID_RGB, NOMINAL_RGB, PATH_RGB = (200, 185, 160), (165, 165, 165), (210, 40, 30)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    add("--env.type", dest="env_type", default="bomb", help=f"{', '.join(AXES_OF)} (default: bomb)")
    add("--axes", type=_parse_names, help="axes, as camera,light (default: every axis and all)")
    add_env_flag(parser, "task", help=f"draw a suite's tasks in place of axes: {', '.join(SUITES)}")
    add("--seeds", type=parse_numbers, default=DEFAULT_SEEDS, help="seeds of the episodes (default: 2,3)")
    size = "pixels of a tile (default: %(default)s)"
    add_env_flag(parser, "image_size", type=int, default=DEFAULT_TILE_SIZE, help=size)
    add(
        "--output",
        type=path_flag,
        default=DEFAULT_FOLDER,
        help="folder of the sheets, AXIS.jpg; sheets of the same names are replaced (default: %(default)s)",
    )
    add("--doc", type=path_flag, help="also write the page that explains the axes, with their sheets")


def run(args: argparse.Namespace) -> int:
    """Draw the sheets and print their paths."""
    one_of("--env.type", args.env_type, AXES_OF)
    sheets = (*AXES_OF[args.env_type], ALL)
    axes = args.axes or sheets
    for axis in axes:
        one_of("--axes", axis, sheets)
    if args.task is not None:
        one_of("--env.task", args.task, SUITES)
        for flag, value in {"axes": args.axes, "doc": args.doc}.items():
            if value is not None:
                raise ValueError(f"--{flag} and --env.task={args.task}: give one of them")
        if args.env_type != "bomb":
            raise ValueError(
                f"--env.task={args.task} is a suite of --env.type=bomb; drop --env.type={args.env_type}"
            )
    if args.env_type != "bomb" and args.doc is not None:
        raise ValueError(f"--doc={args.doc} is written for --env.type=bomb only; drop one of them")
    if args.env_type == "bomb_pusht":
        check_installed()
    if args.env_type == "bomb_libero":
        prepare_libero([LIBERO_TASK])
    if args.output.exists() and not args.output.is_dir():
        raise ValueError(f"--output={args.output} is no folder; name another")
    options = RenderOptions(image_size=args.image_size)
    with reworded({"--seed=": "--seeds: "}):
        for seed in args.seeds:
            EpisodeSpec(seed)
    for axis in tqdm(axes if args.task is None else [args.task], unit="sheet"):
        path = args.output / f"{axis}.jpg"
        if args.task is not None:
            sheet = suite_sheet(args.task, args.seeds, options)
        elif args.env_type == "bomb":
            sheet = axis_sheet(axis, args.seeds, options)
        else:
            sheet = tiles_sheet(
                AXES_OF[args.env_type], TILES_OF[args.env_type], axis, args.seeds, args.image_size
            )
        image = sheet.draw()
        with written_whole(path) as (unfinished,):
            Image.fromarray(image).save(unfinished, quality=JPEG_QUALITY)
        tqdm.write(str(path))
    if args.doc is not None:
        write_page(args.doc, args.output)
        print(args.doc)
    return 0


@dataclass(frozen=True)
class Look:
    """Look of an episode under one condition."""

    images: dict[str, np.ndarray]  # camera -> (S, S, 3) uint8, at the start
    instruction: str
    path_xy: np.ndarray  # (T + 1, 2) metres, of the gripper; (1, 2) when it was not played


def axis_sheet(axis: str, seeds: Sequence[int], options: RenderOptions) -> Sheet:
    """A column for every level of an axis, or of all of them, and rows for what it changes, per seed."""
    axes = NUISANCES if axis == ALL else (axis,)
    changes = {change for name in axes for change in AXES[name].changes}
    summary = f"every axis but {', '.join(sorted(AXES.keys() - axes))}" if axis == ALL else AXES[axis].summary
    if "images" not in changes:
        summary += "; the images stay as they are"
    looks = [
        look_at(f"{axis}:{level}" if level else NONE, seeds, options, "dynamics" in changes)
        for level in LEVELS
    ]
    images: dict[str, list[np.ndarray]] = {}
    for seed, of_seed in zip(seeds, zip(*looks, strict=True), strict=True):
        for camera in CAMERAS if "images" in changes else ():
            images[f"{camera}, seed {seed}"] = [look.images[camera] for look in of_seed]
        if "instruction" in changes:
            tiles = [text_tile(look.instruction, options.image_size) for look in of_seed]
            images[f"instruction, seed {seed}"] = tiles
        if "dynamics" in changes:
            paths = [look.path_xy for look in of_seed]
            images[f"expert's path, seed {seed}"] = [
                path_tile(path, paths[0], options.image_size) for path in paths
            ]
    return Sheet(f"{axis}: {summary}", COLUMNS, {} if axis == ALL else magnitude_rows(AXES[axis]), images)


def suite_sheet(suite: str, seeds: Sequence[int], options: RenderOptions) -> Sheet:
    """A row for every numbered task: each seed's instruction, start, and what the expert leaves."""
    images: dict[str, list[np.ndarray]] = {}
    for task_id in range(find_suite(suite).num_tasks):
        (spec,) = specs_of_tasks(EpisodeSpec(seeds[0], suite), [task_id])
        env = make_env(spec, options)
        for seed in seeds:
            first, *_, last = play(env, replace(spec, seed=seed), expert_agent())
            shown = [moment.observation[PIXELS][CAMERAS[0]] for moment in (first, last)]
            row = images.setdefault(f"task {task_id}", [])
            row += [text_tile(first.instruction, options.image_size), *shown]
        env.close()
    columns = [f"{what}, seed {seed}" for seed in seeds for what in ("instruction", "start", "end")]
    return Sheet(f"{suite}: what the expert does in each task", columns, images=images)


def tiles_sheet(
    table: Mapping[str, Axis], tiles_of: TilesOf, axis: str, seeds: Sequence[int], image_size: int
) -> Sheet:
    """Return the sheet of another environment with a table of axes: a row per kind of tile and seed."""
    axes = nuisances_of(table) if axis == ALL else (axis,)
    helps = ", ".join(sorted(table.keys() - set(nuisances_of(table))))
    changes = {change for name in axes for change in table[name].changes}
    summary = f"every axis{f' but {helps}' if helps else ''}" if axis == ALL else table[axis].summary
    images: dict[str, list[np.ndarray]] = {}
    for seed in seeds:
        for level in LEVELS:
            tiles = tiles_of(f"{axis}:{level}" if level else NONE, seed, image_size, changes)
            for name, tile in tiles.items():
                images.setdefault(f"{name}, seed {seed}", []).append(tile)
    rows = {} if axis == ALL else magnitude_rows(table[axis])
    return Sheet(f"{axis}: {summary}", COLUMNS, rows, images)


def pusht_tiles(condition: str, seed: int, image_size: int, changes: set[str]) -> dict[str, np.ndarray]:
    """Return tiles of the start of a PushT episode; dynamics show after some steps through the block."""
    spec = PushTSpec(seed, perturbations=condition)
    env = make_pusht_env(spec, image_size)
    observation, info = env.reset(seed=seed)
    tiles = {}
    if "images" in changes:
        tiles["start"] = observation["pixels"]
    if "instruction" in changes:
        tiles["instruction"] = text_tile(env.get_wrapper_attr("task_description"), image_size)
    if "dynamics" in changes:
        beyond = np.clip(2 * info["block_pose"][:2] - info["pos_agent"], 40, 470)
        for _ in range(PUSHED_STEPS):
            observation, *_ = env.step(beyond)
        tiles[f"after {PUSHED_STEPS} steps"] = observation["pixels"]
    env.close()
    return tiles


def libero_tiles(condition: str, seed: int, image_size: int, changes: set[str]) -> dict[str, np.ndarray]:
    """Return tiles of both cameras, upright; dynamics show after the same actions."""
    env = make_libero_env(LiberoSpec(seed, LIBERO_TASK, perturbations=condition), image_size)
    observation, _ = env.reset(seed=seed)
    tiles = {}
    if "images" in changes:
        tiles |= {name: image[::-1, ::-1] for name, image in observation["pixels"].items()}
    if "instruction" in changes:
        tiles["instruction"] = text_tile(env.get_wrapper_attr("task_description"), image_size)
    if "dynamics" in changes:
        for action in LIBERO_ACTIONS:
            observation, *_ = env.step(np.array(action, np.float32))
        tiles[f"after {len(LIBERO_ACTIONS)} steps"] = observation["pixels"]["image"][::-1, ::-1]
    env.close()
    return tiles


TILES_OF: dict[str, TilesOf] = {"bomb_pusht": pusht_tiles, "bomb_libero": libero_tiles}


def look_at(condition: str, seeds: Sequence[int], options: RenderOptions, played: bool) -> list[Look]:
    """Show each seed's episode under a condition; `played` by the expert to its end, or only begun."""
    env = make_env(EpisodeSpec(seeds[0], perturbations=condition), options)
    looks = []
    for seed in seeds:
        spec = EpisodeSpec(seed, perturbations=condition)
        moments = play(env, spec, expert_agent())
        first = next(moments)
        path = [moment.state.gripper_xyz[:2] for moment in (first, *(moments if played else ()))]
        looks.append(Look(first.observation[PIXELS], first.instruction, np.array(path)))
    env.close()
    return looks


def magnitude_rows(axis: Axis) -> dict[str, list[str]]:
    """Return an axis' magnitudes by level, as rows of words under the columns."""
    return {
        f"{name}, {magnitude.unit}": ["", *(f"{value:g}" for value in magnitude.levels)]
        for name, magnitude in axis.magnitudes.items()
    }


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


def _parse_names(text: str) -> tuple[str, ...]:
    """Read a list of axes: ("camera", "light") from "camera,light" and from "[camera,light]"."""
    return tuple(name.strip() for name in text.strip("[]").split(","))
