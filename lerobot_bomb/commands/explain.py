"""``lerobot-bomb explain``: why does a policy do what it does? Interventions, moment by moment."""

import argparse
import json
import shlex
import sys
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from lerobot_bomb.bomb.episode import TEST_SEEDS
from lerobot_bomb.checkpoints.names import check_checkpoint
from lerobot_bomb.commands.arguments import add_checkpoint_arguments, check_at_least, path_flag
from lerobot_bomb.commands.results_files import read_record
from lerobot_bomb.commands.view import add_viewed_arguments, viewed_of
from lerobot_bomb.conditions import NONE
from lerobot_bomb.environments import BOMB
from lerobot_bomb.files import check_new_folder, written_whole
from lerobot_bomb.flags import one_of
from lerobot_bomb.viewing.episode import Viewed
from lerobot_bomb.viewing.replay import Replay

if TYPE_CHECKING:
    from lerobot_bomb.explain.episode import ExplainedMoment
    from lerobot_bomb.explain.probes import LayerProbe
    from lerobot_bomb.report.table import Section
    from lerobot_bomb.viewing.checkpoint import LoadedPolicy

DEFAULT_FOLDER = Path("outputs/explain")
DEFAULT_GRID = 8
PAGE, NUMBERS, RECORDING = "explanation.html", "explanation.json", "explanation.rrd"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    results = "results file: explain the episode of one of its records, and that record's policy"
    add("--results", type=path_flag, metavar="FILE", help=results)
    add("--line", type=int, help="line of the record in --results, from 1 on (default: 1)")
    add("--seed", type=int, help=f"seed of the episode (default: {TEST_SEEDS[0]}, or the record's)")
    add(
        "--episodes",
        type=int,
        default=1,
        help="number of episodes; several give a page of means (default: 1)",
    )
    add("--step", type=int, help="control step to explain (default: one of each phase)")
    add("--grid", type=int, default=DEFAULT_GRID, help=f"patches along a side (default: {DEFAULT_GRID})")
    add("--fill", default="mean", help="what replaces the hidden part: mean, blur or other (default: mean)")
    add(
        "--words", action="append", default=[], help="other words of the instruction to hide; may be repeated"
    )
    add_viewed_arguments(parser)
    add_checkpoint_arguments(parser, "checkpoint to explain (default: the record's)")
    add("--output", type=path_flag, default=DEFAULT_FOLDER, help=f"new folder (default: {DEFAULT_FOLDER})")


def run(args: argparse.Namespace) -> int:
    """Explain episodes: print the findings; write a page, its numbers and, for one episode, a recording."""
    check_at_least(args, episodes=1, grid=1)
    if args.episodes > 1 and args.step is not None:
        raise ValueError(f"--step={args.step} is of one episode; drop it or --episodes={args.episodes}")
    check_new_folder("output", args.output)
    query = _of_flags(args) if args.results is None else _of_record(args)
    _check_images(args, query.viewed(query.seed).env_flags["image_size"])
    return (_explain_one if args.episodes == 1 else _explain_several)(args, query)


def _check_images(args: argparse.Namespace, image_size: int) -> None:
    """Raise a ValueError for a wrong --fill or --grid, before anything is loaded."""
    from lerobot_bomb.explain.images import FILLINGS, patch_masks  # torch: seconds

    one_of("--fill", args.fill, FILLINGS)
    patch_masks(args.grid, image_size, image_size)


def _of_flags(args: argparse.Namespace) -> "_Query":
    if args.policy_path is None:
        raise ValueError("--policy.path is missing: the checkpoint that is explained; or give --results=FILE")
    if args.line is not None:
        raise ValueError(f"--line={args.line} is of --results=FILE; drop it, or name the file")

    def viewed(seed: int) -> Viewed:
        return viewed_of(argparse.Namespace(**vars(args) | {"seed": seed}))

    seed = TEST_SEEDS[0] if args.seed is None else args.seed
    return _Query(viewed, seed, args.policy_path, args.policy_device)


def _of_record(args: argparse.Namespace) -> "_Query":
    of_episode = {"image_size": None, "perturbations": (NONE,), "env_type": BOMB.name}
    of_episode |= {"ignore_checkpoint": False}
    of_episode |= {name: default for name, (default, _) in args.own_flags.items()}
    for name, default in of_episode.items():
        if getattr(args, name) != default:
            raise ValueError(f"drop --env.{name.removeprefix('env_')}: the record of --results says it")
    replay = Replay(read_record(args.results, 1 if args.line is None else args.line), args.policy_path)
    if replay.checkpoint is None:
        raise ValueError("this record's policy has no checkpoint, so there is nothing to explain")
    check_checkpoint(replay.checkpoint)
    seed = replay.record.spec.seed if args.seed is None else args.seed
    return _Query(lambda seed: replay.viewed(seed=seed), seed, replay.checkpoint, args.policy_device)


@dataclass(frozen=True)
class _Query:
    """Episodes and checkpoint to explain."""

    viewed: Callable[[int], Viewed]  # of a seed
    seed: int
    checkpoint: Path
    device: str | None

    def load(self) -> "LoadedPolicy":
        from lerobot_bomb.viewing.checkpoint import load_policy  # LeRobot and torch: seconds

        viewed = self.viewed(self.seed)
        return load_policy(self.checkpoint, self.device, viewed.env_type, viewed.env_flags, self.seed)


def _moments(
    args: argparse.Namespace, query: _Query, seed: int, loaded: "LoadedPolicy"
) -> "tuple[list[ExplainedMoment], Any]":
    """Explain the chosen moments of an episode; return them with the episode's result."""
    from lerobot_bomb.explain.episode import Settings, explain_moment
    from lerobot_bomb.explain.snapshots import at_step, middle_of_phases, take_snapshots

    viewed = query.viewed(seed)
    snapshots, result = take_snapshots(viewed, loaded)
    chosen = middle_of_phases(snapshots) if args.step is None else [at_step(snapshots, args.step)]
    elsewhere = take_snapshots(query.viewed(seed + 1), loaded)[0]
    others = {each.phase: each for each in (elsewhere[0], *middle_of_phases(elsewhere))}
    settings = Settings(args.grid, args.fill, tuple(args.words))
    control_mode = getattr(viewed.spec, "control_mode", None)
    moments = tqdm(chosen, desc="moments", leave=False, disable=args.episodes > 1)
    return [
        explain_moment(loaded, each, settings, control_mode, others.get(each.phase, elsewhere[0]))
        for each in moments
    ], result


def _explain_one(args: argparse.Namespace, query: _Query) -> int:
    from lerobot_bomb.explain.masked_episodes import masks_of, run_masked
    from lerobot_bomb.explain.recording import write_recording
    from lerobot_bomb.report.explanation import moment_sections, overview_section, traces_section

    viewed, loaded = query.viewed(query.seed), query.load()
    moments, result = _moments(args, query, query.seed, loaded)
    episodes = {}
    if moments[0].snapshot.objects and args.fill != "other":
        episodes = run_masked(viewed, loaded, masks_of(moments[0].snapshot, loaded, args.fill))
    name = viewed.name(loaded.config.type)
    sections = [overview_section(viewed.log.describe(result), moments, _command())]
    sections += [section for each in moments for section in moment_sections(each)]
    sections += [traces_section(episodes)] if episodes else []
    numbers = {
        "result": result.as_json(),
        "moments": [each.as_json() for each in moments],
        "masked_episodes": {mask: episode.result.as_json() for mask, episode in episodes.items()},
    }
    with written_whole(args.output) as (folder,):
        _write(folder, f"Why: {name}", sections, numbers)
        write_recording(folder / RECORDING, name, viewed.fps, moments)
    for each in moments:
        print(each.title, *(f"  {finding}" for finding in each.findings), sep="\n")
    print(*(args.output / file for file in (PAGE, NUMBERS, RECORDING)), sep="\n")
    return 0


def _explain_several(args: argparse.Namespace, query: _Query) -> int:
    from lerobot_bomb.report.explanation import aggregate_sections, probes_section

    loaded, seeds = query.load(), range(query.seed, query.seed + args.episodes)
    episodes = [_moments(args, query, seed, loaded) for seed in tqdm(seeds, desc="episodes")]
    by_phase: dict[str, list[ExplainedMoment]] = defaultdict(list)
    for moments, _ in episodes:
        for each in moments:
            by_phase[each.snapshot.phase].append(each)
    sections = aggregate_sections([result for _, result in episodes], by_phase, _command())
    if probes := _probes([moments[0] for moments, _ in episodes]):
        sections.append(probes_section(probes))
    numbers = {
        "sections": [section.as_json() for section in sections],
        "episodes": [
            {"result": result.as_json(), "moments": [each.as_json() for each in moments]}
            for moments, result in episodes
        ],
    }
    with written_whole(args.output) as (folder,):
        _write(folder, f"Why: {query.viewed(query.seed).group}, {args.episodes} episodes", sections, numbers)
    print(*(args.output / file for file in (PAGE, NUMBERS)), sep="\n")
    return 0


def _probes(moments: "Sequence[ExplainedMoment]") -> "list[LayerProbe]":
    """Probe layers for target and stone; empty if too few episodes hold these and the layers' states."""
    from lerobot_bomb.explain.probes import MIN_EPISODES, probe_layers

    known = [each for each in moments if each.states and each.snapshot.target is not None]
    if len(known) < MIN_EPISODES:
        return []
    targets = np.array([each.snapshot.target for each in known])
    states = {place: np.stack([each.states[place] for each in known]) for place in known[0].states}
    stones = np.stack([each.snapshot.stone_xyz for each in known if each.snapshot.stone_xyz is not None])
    classes = {"target's row": targets[:, 0], "target's column": targets[:, 1]}
    return probe_layers(states, classes, {"stone's place on the table": stones[:, :2]})


def _command() -> str:
    return shlex.join(["lerobot-bomb", *sys.argv[1:]])


def _write(folder: Path, title: str, sections: "Sequence[Section]", numbers: dict[str, Any]) -> None:
    from lerobot_bomb.report.page import render

    folder.mkdir()
    (folder / PAGE).write_text(render(title, sections))
    (folder / NUMBERS).write_text(json.dumps({"command": _command(), **numbers}, indent=1) + "\n")
