"""``lerobot-bomb view gallery``: what each perturbation axis does, or a suite's tasks, on sheets."""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from pkgutil import resolve_name

import numpy as np
from PIL import Image
from tqdm import tqdm

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.observation import CAMERAS, PIXELS, RenderOptions
from lerobot_bomb.bomb.suite import find_suite, specs_of_tasks
from lerobot_bomb.bomb.suites import SUITES
from lerobot_bomb.commands.arguments import add_env_flag, parse_numbers, path_flag
from lerobot_bomb.conditions import ALL, MAX_LEVEL, NONE, Axis, nuisances_of
from lerobot_bomb.environments import BOMB, ENVIRONMENTS, EnvType
from lerobot_bomb.envs.rollout import expert_agent, make_env, run_episode
from lerobot_bomb.files import written_whole
from lerobot_bomb.flags import one_of, rewording_errors
from lerobot_bomb.viewing.perturbations_page import write_page
from lerobot_bomb.viewing.sheet import Sheet, text_tile

LEVELS = range(MAX_LEVEL + 1)
COLUMNS = ["nominal", *(f"level {level}" for level in LEVELS[1:])]
DEFAULT_SEEDS = (2, 3)
DEFAULT_TILE_SIZE = 144  # pixels
DEFAULT_FOLDER = Path("outputs/gallery")
JPEG_QUALITY = 88


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    add("--env.type", dest="env_type", default=BOMB.name, help=f"{', '.join(_drawn_types())} (default: bomb)")
    add("--axes", type=_parse_names, help="as camera,light (default: every axis and all)")
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


def _drawn_types() -> list[str]:
    return [name for name, each in ENVIRONMENTS.items() if each.tiles_at]


def run(args: argparse.Namespace) -> int:
    """Draw the sheets and print their paths."""
    one_of("--env.type", args.env_type, _drawn_types())
    env = ENVIRONMENTS[args.env_type]
    sheets = (*env.record.condition.axes, ALL)
    axes = args.axes or sheets
    for axis in axes:
        one_of("--axes", axis, sheets)
    if args.task is not None:
        one_of("--env.task", args.task, SUITES)
        for flag, value in {"axes": args.axes, "doc": args.doc}.items():
            if value is not None:
                raise ValueError(f"--{flag} and --env.task={args.task}: give one of them")
        if env is not BOMB:
            raise ValueError(
                f"--env.task={args.task} is a suite of --env.type=bomb; drop --env.type={args.env_type}"
            )
    if env is not BOMB and args.doc is not None:
        raise ValueError(f"--doc={args.doc} is written for --env.type=bomb only; drop one of them")
    env.check(env.record.tasks[:1])
    if args.output.exists() and not args.output.is_dir():
        raise ValueError(f"--output={args.output} is no folder; name another")
    options = RenderOptions(image_size=args.image_size)
    with rewording_errors({"--seed=": "--seeds: "}):
        for seed in args.seeds:
            EpisodeSpec(seed)
    for axis in tqdm(axes if args.task is None else [args.task], unit="sheet"):
        path = args.output / f"{axis}.jpg"
        if args.task is None:
            sheet = axis_sheet(env, axis, args.seeds, args.image_size)
        else:
            sheet = suite_sheet(args.task, args.seeds, options)
        image = sheet.draw()
        with written_whole(path) as (unfinished,):
            Image.fromarray(image).save(unfinished, quality=JPEG_QUALITY)
        tqdm.write(str(path))
    if args.doc is not None:
        write_page(args.doc, args.output)
        print(args.doc)
    return 0


def axis_sheet(env: EnvType, axis: str, seeds: Sequence[int], image_size: int) -> Sheet:
    """Draw a column for every level of an axis, or of `all`, and rows for each seed."""
    axes = env.record.condition.axes
    names = nuisances_of(axes) if axis == ALL else (axis,)
    changes = {change for name in names for change in axes[name].changes}
    helps = ", ".join(sorted(axes.keys() - set(names)))
    summary = f"every axis{f' but {helps}' if helps else ''}" if axis == ALL else axes[axis].summary
    if "images" not in changes:
        summary += "; the images stay as they are"
    images: dict[str, list[np.ndarray]] = {}
    for seed in seeds:
        for level in LEVELS:
            tiles = resolve_name(env.tiles_at)(
                f"{axis}:{level}" if level else NONE, seed, image_size, changes
            )
            for name, tile in tiles.items():
                images.setdefault(f"{name}, seed {seed}", []).append(tile)
    rows = {} if axis == ALL else magnitude_rows(axes[axis])
    return Sheet(f"{axis}: {summary}", COLUMNS, rows, images)


def suite_sheet(suite: str, seeds: Sequence[int], options: RenderOptions) -> Sheet:
    """Draw a row for every numbered task: each seed's instruction, start, and end by the expert."""
    images: dict[str, list[np.ndarray]] = {}
    for task_id in range(find_suite(suite).num_tasks):
        (spec,) = specs_of_tasks(EpisodeSpec(seeds[0], suite), [task_id])
        env = make_env(spec, options)
        for seed in seeds:
            first, *_, last = run_episode(env, replace(spec, seed=seed), expert_agent())
            shown = [moment.observation[PIXELS][CAMERAS[0]] for moment in (first, last)]
            row = images.setdefault(f"task {task_id}", [])
            row += [text_tile(first.instruction, options.image_size), *shown]
        env.close()
    columns = [f"{what}, seed {seed}" for seed in seeds for what in ("instruction", "start", "end")]
    return Sheet(f"{suite}: what the expert does in each task", columns, images=images)


def magnitude_rows(axis: Axis) -> dict[str, list[str]]:
    """Return an axis' magnitudes by level, as rows of words under the columns."""
    return {
        f"{name}, {magnitude.unit}": ["", *(f"{value:g}" for value in magnitude.levels)]
        for name, magnitude in axis.magnitudes.items()
    }


def _parse_names(text: str) -> tuple[str, ...]:
    """Read a list of axes: ("camera", "light") from "camera,light" and from "[camera,light]"."""
    return tuple(name.strip() for name in text.strip("[]").split(","))
