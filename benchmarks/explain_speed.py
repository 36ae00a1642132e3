"""Cost of a map of patches, and what activation patching saves by encoding a prompt once.

    OMP_NUM_THREADS=1 python benchmarks/explain_speed.py --policy.path=bomb:fdvla --json explain.json

Beside the map of one frame, 8 x 8 patches of two cameras, stands its peer: as many plain passes of the policy
in one batch. Beside the heads that are put back, the same with every row encoded again. They take turns.
"""

import argparse
import time
from collections.abc import Callable
from contextlib import closing
from statistics import median

import torch
from machine import add_machine_arguments, positive, require_idle_machine, write_figures
from torch import Tensor

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.observation import RenderOptions
from lerobot_bomb.commands.arguments import checkpoint_flag
from lerobot_bomb.envs.rollout import make_env
from lerobot_bomb.explain.activations import all_heads
from lerobot_bomb.explain.images import filling, patch_masks
from lerobot_bomb.explain.other_policies import scored
from lerobot_bomb.explain.question import Question
from lerobot_bomb.explain.restoration import Corruption
from lerobot_bomb.explain.scored_policy import repeated
from lerobot_bomb.tables import print_table
from lerobot_bomb.viewing.checkpoint import load_policy

GRID = 8
MAX_MAP_RATIO = 1.3


def main() -> None:
    """Measure, print medians and ratios."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--policy.path", dest="path", type=checkpoint_flag, default="bomb:vla0_smol")
    parser.add_argument("--image_size", type=positive, default=64, help="pixels (default: 64)")
    parser.add_argument("--repeats", type=positive, default=9)
    add_machine_arguments(parser)
    args = parser.parse_args()
    require_idle_machine(args.force)
    policy = load_policy(args.path, "cpu", "bomb", {"image_size": args.image_size}, seed=0)
    spec = EpisodeSpec(seed=100_000)
    with closing(make_env(spec, RenderOptions(args.image_size))) as env:
        observed, _ = env.reset(seed=spec.seed)
        raw = policy.observe([observed], [env.get_wrapper_attr("task_description")])
    asked = scored(policy.policy, policy.postprocess)
    keys = [key for key in raw if key.startswith("observation.images.")]
    num_rows = len(keys) * GRID**2
    question = Question(asked, policy.prepare, raw, batch_size=num_rows)
    fillings = {key: filling(raw[key][0], "mean", 1.0) for key in keys}

    def map_of_patches() -> None:
        for key in keys:
            masks = patch_masks(GRID, *raw[key].shape[2:])
            question.effects_of_masks(key, masks, fillings[key])

    @torch.no_grad()
    def passes() -> None:
        asked.score(asked.encode(policy.prepare(repeated(raw, num_rows))), question.answer)

    changed = {keys[0]: fillings[keys[0]][None]}
    corruption = Corruption(question, question.encode(changed, 1))
    units = [[unit] for unit in all_heads(asked.layers)]

    def encoded_once() -> Tensor:
        return corruption.restore(units).scores

    def encoded_anew() -> Tensor:
        rows = question.encode(
            {key: images.expand(len(units), -1, -1, -1) for key, images in changed.items()}, len(units)
        )
        corruption.rows = {key: values[:1] for key, values in rows.items()}
        return corruption.restore(units).scores

    map_ms, passes_ms = in_turns(map_of_patches, passes, args.repeats)
    once_ms, anew_ms = in_turns(encoded_once, encoded_anew, args.repeats)
    figures = {
        "map_ms": map_ms,
        "passes_ms": passes_ms,
        "map_ratio": map_ms / passes_ms,
        "restored_ms": once_ms,
        "restored_anew_ms": anew_ms,
        "restored_ratio": anew_ms / once_ms,
    }
    print_table(
        [f"{args.path.name}, median of {args.repeats}", "ms", "ratio"],
        [
            [f"map of {num_rows} patches", f"{map_ms:.1f}", f"{map_ms / passes_ms:.2f} (<= {MAX_MAP_RATIO})"],
            [f"{num_rows} passes in one batch", f"{passes_ms:.1f}", "1"],
            [f"{len(units)} heads put back, encoded once", f"{once_ms:.1f}", "1"],
            [f"{len(units)} heads put back, each row encoded", f"{anew_ms:.1f}", f"{anew_ms / once_ms:.2f}"],
        ],
    )
    write_figures(args.json, figures)


def in_turns(first: Callable[[], object], second: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Median milliseconds of both, after one run of each that is not counted."""
    times: list[list[float]] = [[], []]
    for _ in range(repeats + 1):
        for function, kept in zip((first, second), times, strict=True):
            start = time.perf_counter()
            function()
            kept.append(1e3 * (time.perf_counter() - start))
    first_ms, second_ms = (median(kept[1:]) for kept in times)
    return first_ms, second_ms


if __name__ == "__main__":
    main()
