"""``lerobot-bomb doctor dataset``: are a dataset's statistics those of its frames?"""

import argparse

from lerobot_bomb.commands.arguments import ANSWER_IS_NO, path_flag


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("root", type=path_flag, metavar="ROOT", help="folder of a LeRobotDataset")
    parser.add_argument("--mend", action="store_true", help="write those of all frames to meta/stats.json")


def run(args: argparse.Namespace) -> int:
    """Print which statistics are wrong; exit code 3 if some are and are not mended."""
    from lerobot_bomb.data.statistics import mending, write_statistics, wrong_statistics  # LeRobot: seconds

    wrong = wrong_statistics(args.root)
    if not wrong:
        print(f"{args.root}: the statistics of its numbers are those of all frames")
        return 0
    print(*wrong, sep="\n")
    if args.mend:
        write_statistics(args.root)
        print(f"mended in {args.root}; a policy that was trained on it keeps those that it was trained with")
        return 0
    print(mending(args.root))
    return ANSWER_IS_NO
