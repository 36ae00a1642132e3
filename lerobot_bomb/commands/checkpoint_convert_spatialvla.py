"""``lerobot-bomb checkpoint convert-spatialvla``: a published SpatialVLA folder as a checkpoint."""

import argparse

from lerobot_bomb.commands.arguments import path_flag
from lerobot_bomb.files import check_new_folder


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the folder, and flags for what its files do not say."""
    add = parser.add_argument
    add(
        "folder",
        type=path_flag,
        help="folder with config.json, processor_config.json, tokenizer.json, weights",
    )
    add("--output", type=path_flag, required=True, help="new folder for the checkpoint")
    statistics = "dataset whose statistics scale the actions, if the folder has several"
    add("--statistics", help=statistics)
    add("--camera", default="image", help="name of the camera, observation.images.NAME (default: image)")
    grid = "gs_*.json from which the folder's edges were made; for --decode_point=cond_mean"
    add("--grid", type=path_flag, help=grid)
    add("--min_sigma", type=float, help="least sigma of --grid (default: the folder's, or the published 0.5)")
    template = (
        "text around the instruction, which {} stands for: '{}' (default), as the original's processor "
        "writes it, or 'What action should the robot take to {}?', as its slides do"
    )
    add("--task_template", default="{}", help=template)
    point = "value of a cell: mid, as in the original (default), or cond_mean, the mean by --grid"
    add("--decode_point", default="mid", choices=("mid", "cond_mean"), help=point)


def run(args: argparse.Namespace) -> int:
    """Write the checkpoint."""
    check_new_folder("--output", args.output)
    if not args.folder.is_dir():
        raise ValueError(f"{args.folder}: there is no such folder")
    from lerobot_bomb.checkpoints.spatialvla_folder import Published, convert  # LeRobot and torch: seconds

    options = (args.statistics, args.camera, args.grid, args.min_sigma, args.task_template, args.decode_point)
    prompt = convert(Published(args.folder, *options), args.output)
    print(f"{prompt}\nwritten to {args.output}: --policy.path={args.output}")
    return 0
