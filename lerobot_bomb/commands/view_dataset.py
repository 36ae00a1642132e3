"""``lerobot-bomb view --dataset=ROOT``: recorded episodes as a contact sheet or a video."""

import argparse
from pathlib import Path

import numpy as np
from tqdm import tqdm

from lerobot_bomb.files import file_names, written_whole
from lerobot_bomb.viewing.episode import check_new

SUFFIXES = (".png", ".mp4")
NUM_EPISODES = 8  # that are shown unless others are named
OWN = {"dataset", "episodes", "output"}


def view_dataset(args: argparse.Namespace, defaults: dict[str, object], folder: Path) -> int:
    """Write a sheet, or a video if `--output` ends so; print its path."""
    for name, default in defaults.items():
        if name not in OWN and getattr(args, name) != default:
            raise ValueError(
                f"--{name}={getattr(args, name)} is of an episode to be run, not of --dataset; drop it"
            )
    from lerobot_bomb.viewing.recorded import ViewedDataset, write_sheet, write_video

    root: Path = args.dataset
    if not root.is_dir():
        raise ValueError(f"--dataset={root}: there is no such folder; give the --root of a recording")
    path = _output(args.output, folder, root)
    check_new([path])
    dataset = ViewedDataset.read(root)
    num_episodes = len(dataset.episodes)
    episodes = args.episodes
    if episodes is None:
        spread = np.linspace(0, num_episodes - 1, min(NUM_EPISODES, num_episodes))
        episodes = tuple(spread.round().astype(int).tolist())
    if (last := max(episodes)) >= num_episodes:
        raise ValueError(f"--episodes={last}: {root} has episodes 0 to {num_episodes - 1}")
    with written_whole(path) as (unfinished,):
        if path.suffix == ".png":
            write_sheet(dataset, episodes, unfinished)
        else:
            with tqdm(total=len(episodes), unit=" episodes") as bar:
                write_video(dataset, episodes, unfinished, lambda _: bar.update())
    print(path)
    return 0


def _output(output: Path | None, folder: Path, root: Path) -> Path:
    (name,) = file_names([f"{root.resolve().name}.png"])
    if output is None:
        return folder / name
    if output.is_dir():
        return output / name
    if output.suffix not in SUFFIXES:
        raise ValueError(f"--output={output} must end in {' or '.join(SUFFIXES)}, or be a folder that exists")
    return output
