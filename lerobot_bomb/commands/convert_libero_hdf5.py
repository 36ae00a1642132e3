"""``lerobot-bomb convert libero-hdf5``: demonstrations of LIBERO as a LeRobotDataset."""

import argparse

from lerobot_bomb.commands.arguments import switch
from lerobot_bomb.commands.conversions import add_conversion_arguments, new_root
from lerobot_bomb.data.resumable import terminated_in_order


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the source, the dataset and how frames are stored."""
    add_conversion_arguments(parser, "the file, or the folder of a suite's files")
    add = parser.add_argument
    add("--images", **switch(), help="store images (lossless) instead of videos")
    add(
        "--skip_noops",
        **switch(),
        help="leave out frames whose action moves neither arm nor gripper (default: keep all)",
    )
    add(
        "--image_convention",
        help="how the files hold images: opengl, upside down; opencv, upright; lerobot, turned already "
        "(default: what each file says, else opengl)",
    )


def run(args: argparse.Namespace) -> int:
    """Convert, and print where the dataset is."""
    root = new_root(args)
    from lerobot_bomb.data.libero_conversion import convert_libero

    options = (args.resume, args.images, args.skip_noops, args.image_convention)
    with terminated_in_order():
        progress = convert_libero(args.path, args.repo_id, root, *options)
    print(f"{progress.num_episodes} episodes, {progress.num_frames} frames: {root}")
    return 0
