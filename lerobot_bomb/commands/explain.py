"""``lerobot-bomb explain``: why does a policy do what it does? Interventions, moment by moment."""

import argparse
import json
import shlex
import sys
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain, count
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
from lerobot_bomb.results.record import Record
from lerobot_bomb.viewing.episode import Viewed
from lerobot_bomb.viewing.replay import Replay

if TYPE_CHECKING:
    from lerobot_bomb.explain.episode import ExplainedMoment
    from lerobot_bomb.explain.film import EpisodeRun
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
    numbered = f"{DEFAULT_FOLDER}, {DEFAULT_FOLDER}-2, ..."
    add("--output", type=path_flag, help=f"new folder (default: the first free one of {numbered})")


def run(args: argparse.Namespace) -> int:
    """Explain episodes: print the verdict; write a page, its numbers and, for one episode, a recording."""
    check_at_least(args, episodes=1, grid=1)
    if args.episodes > 1 and args.step is not None:
        raise ValueError(f"--step={args.step} is of one episode; drop it or --episodes={args.episodes}")
    args.output = args.output or free_folder()
    check_new_folder("--output", args.output)
    query = _of_flags(args) if args.results is None else _of_record(args)
    _check_images(args, query.viewed(query.seed).env_flags["image_size"])
    return (_explain_one if args.episodes == 1 else _explain_several)(args, query)


def free_folder() -> Path:
    """Return the default folder, or the first free one of those numbered from 2 on."""
    numbered = (DEFAULT_FOLDER.with_name(f"{DEFAULT_FOLDER.name}-{number}") for number in count(2))
    return next(folder for folder in chain([DEFAULT_FOLDER], numbered) if not folder.exists())


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

    def viewed(seed: int, perturbations: str | None = None) -> Viewed:
        changed = {} if perturbations is None else {"perturbations": (perturbations,)}
        return viewed_of(argparse.Namespace(**vars(args) | {"seed": seed} | changed))

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
    recorded = replay.record if seed == replay.record.spec.seed else None

    def viewed(seed: int, perturbations: str | None = None) -> Viewed:
        return replay.viewed(perturbations, seed)

    return _Query(viewed, seed, replay.checkpoint, args.policy_device, recorded)


@dataclass(frozen=True)
class _Query:
    """Episodes and checkpoint to explain."""

    viewed: Callable[..., Viewed]  # of a seed, and of other perturbations than its own
    seed: int
    checkpoint: Path
    device: str | None
    recorded: Record | None = None  # of this episode, before

    def load(self) -> "LoadedPolicy":
        from lerobot_bomb.viewing.checkpoint import load_policy  # LeRobot and torch: seconds

        viewed = self.viewed(self.seed)
        return load_policy(self.checkpoint, self.device, viewed.env_type, viewed.env_flags, self.seed)


def _moments(
    args: argparse.Namespace, query: _Query, seed: int, loaded: "LoadedPolicy"
) -> "tuple[list[ExplainedMoment], EpisodeRun]":
    """Explain the chosen moments of an episode; return them with the episode as it ran."""
    from lerobot_bomb.explain.episode import Settings, explain_moment
    from lerobot_bomb.explain.snapshots import at_step, middle_of_phases, take_snapshots

    viewed = query.viewed(seed)
    snapshots, run = take_snapshots(viewed, loaded)
    chosen = middle_of_phases(snapshots) if args.step is None else [at_step(snapshots, args.step)]
    elsewhere = take_snapshots(query.viewed(seed + 1), loaded)[0]
    others = {each.phase: each for each in (elsewhere[0], *middle_of_phases(elsewhere))}
    settings = Settings(args.grid, args.fill, tuple(args.words))
    control_mode = getattr(viewed.spec, "control_mode", None)
    moments = tqdm(chosen, desc="moments", leave=False, disable=args.episodes > 1)
    return [
        explain_moment(loaded, each, settings, control_mode, others.get(each.phase, elsewhere[0]))
        for each in moments
    ], run


def _explain_one(args: argparse.Namespace, query: _Query) -> int:
    from lerobot_bomb.explain.counterfactuals import run_counterfactuals
    from lerobot_bomb.explain.masked_episodes import masks_of, run_masked
    from lerobot_bomb.explain.recording import write_recording
    from lerobot_bomb.explain.verdict import verdict
    from lerobot_bomb.report.explanation import episode_sections

    viewed, loaded = query.viewed(query.seed), query.load()
    moments, run = _moments(args, query, query.seed, loaded)
    masked = {}
    if moments[0].snapshot.objects and args.fill != "other":
        masked = run_masked(viewed, loaded, masks_of(moments[0].snapshot, loaded, args.fill))
    counterfactuals = run_counterfactuals(run.result, partial(query.viewed, query.seed), loaded)
    numbers = {
        "result": run.result.as_json(),
        "recorded": None if query.recorded is None else query.recorded.as_json(),
        "moments": [each.as_json() for each in moments],
        "masked_episodes": {mask: each.result.as_json() for mask, each in masked.items()},
        "masked_paths": {mask: each.paths for mask, each in masked.items()},
        "counterfactuals": [each.as_json() for each in counterfactuals],
        **run.paths,
    }
    sentences = verdict([numbers])
    sections = episode_sections(sentences, moments, run, masked, counterfactuals, _command())
    name = viewed.name(loaded.config.type)
    question = "Why did it succeed?" if run.result.is_success else "Why did it fail?"
    spec, task = viewed.spec, viewed.group.partition(".")[0]
    title = f"{question} {loaded.config.type}, {task}, {spec.perturbations}, seed {spec.seed}"
    with written_whole(args.output) as (folder,):
        _write(folder, title, sections, {"verdict": sentences, **numbers})
        write_recording(folder / RECORDING, name, viewed.fps, moments)
    print(*sentences, *(args.output / file for file in (PAGE, NUMBERS, RECORDING)), sep="\n")
    return 0


def _explain_several(args: argparse.Namespace, query: _Query) -> int:
    from lerobot_bomb.explain.verdict import verdict
    from lerobot_bomb.report.explained_several import aggregate_sections, probes_section

    loaded, seeds = query.load(), range(query.seed, query.seed + args.episodes)
    episodes = [_moments(args, query, seed, loaded) for seed in tqdm(seeds, desc="episodes")]
    by_phase: dict[str, list[ExplainedMoment]] = defaultdict(list)
    for moments, _ in episodes:
        for each in moments:
            by_phase[each.snapshot.phase].append(each)
    numbers = [
        {"result": run.result.as_json(), "moments": [each.as_json() for each in moments]}
        for moments, run in episodes
    ]
    sentences = verdict(numbers)
    sections = aggregate_sections(sentences, by_phase, _command())
    if probes := _probes([moments[0] for moments, _ in episodes]):
        sections.insert(-1, probes_section(probes))
    told = {"verdict": sentences, "sections": [each.as_json() for each in sections], "episodes": numbers}
    what = f"{loaded.config.type}, {query.viewed(query.seed).group}"
    title = f"What does it depend on? {what}, {args.episodes} episodes"
    with written_whole(args.output) as (folder,):
        _write(folder, title, sections, told)
    print(*sentences, *(args.output / file for file in (PAGE, NUMBERS)), sep="\n")
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
