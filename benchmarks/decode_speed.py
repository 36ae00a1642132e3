"""Speed of writing a chunk of actions: a trained policy's decoder against transformers' `generate`.

    python benchmarks/decode_speed.py --policy.path=CHECKPOINT \
        --dataset.repo_id=USER/pusht --dataset.root=pusht --json decode_speed.json

Both have the same weights, see the same frames of held-out episodes and must write the same answers. Reading
the prompt (prefill) is reported separately; the bars are on the decoding that follows.

`vla0_smol` writes numbers after the same prompt embeddings as `generate` with xgrammar's logits processor.
`spatialvla_grid` chooses cells; its peer is the stock PaliGemma whose last words are the cells, with a logits
processor that lets only those of the slot through. The peer's prefill excludes cropping the images and
building the prompt. A policy with random weights, which sees random images and instructions, comes second:
there a draft has little to use.
"""

import argparse
import logging
from functools import partial
from typing import Any

import torch
from decode_ways import CellsByGenerate, NumbersByGenerate, NumbersByUs, cells_by_us, compare
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.utils.import_utils import register_third_party_plugins
from machine import Rows, finish, make_parser, parse_on_idle_machine, positive, print_rows
from random_policies import features, make_batches
from torch.utils.data import default_collate

from lerobot_bomb.decoding.decoder import Guess, Prompt
from lerobot_bomb.decoding.draft import KnownSymbols, LinearDraft
from lerobot_bomb.decoding.writer import NumberWriter
from lerobot_policy_bomb.spatialvla_grid import SpatialvlaGridConfig
from lerobot_policy_bomb.spatialvla_grid.configuration_spatialvla_grid import DRAFTS
from lerobot_policy_bomb.spatialvla_grid.modeling_spatialvla_grid import SpatialvlaGridPolicy

BATCH_SIZES = 1, 16
RANDOM_DIMS, RANDOM_IMAGE_SIZE = 7, 128  # of the original's actions


def main() -> None:
    """Time answers and print the tables; exit with code 1 if a bar is missed."""
    parser = make_parser(__doc__)
    parser.add_argument(
        "--policy.path", dest="policy_path", required=True, help="vla0_smol or spatialvla_grid"
    )
    parser.add_argument("--dataset.repo_id", dest="repo_id", required=True)
    parser.add_argument("--dataset.root", dest="root")
    parser.add_argument("--episode", type=int, default=180, help="first episode to read (default: 180)")
    parser.add_argument("--repeats", type=positive, default=20, help="answers of each (default: 20)")
    args = parse_on_idle_machine(parser)
    logging.disable(logging.WARNING)
    register_third_party_plugins()
    policy, preprocessor, dataset = load(args)
    timed_types = {
        "vla0_smol": (time_numbers, "ours, linear draft", 4.0),
        "spatialvla_grid": (time_cells, "ours, repeat", 3.0),
    }
    if policy.config.type not in timed_types:
        parser.error(f"--policy.path holds a {policy.config.type}; give a {' or a '.join(timed_types)}")
    time_answers, way, min_ratio = timed_types[policy.config.type]
    figures: dict[str, Rows] = {}
    bars: dict[str, bool] = {}
    for batch_size in BATCH_SIZES:
        name = f"trained, batch of {batch_size}"
        steps = [i * policy.config.n_action_steps for i in range(args.repeats)]
        episodes = range(args.episode, args.episode + batch_size)
        batches = [preprocessor(frames(dataset, episodes, step)) for step in steps]
        figures[name] = time_answers(policy, batches)
        gain = figures[name][way]["decode_gain"]
        bars[f"{name}: decode {gain:.1f} times faster (bar {min_ratio:g})"] = gain >= min_ratio
    if policy.config.type == "spatialvla_grid":
        policy = random_policy()
        for batch_size in BATCH_SIZES:
            name = f"random, {RANDOM_DIMS} action dims, batch of {batch_size}"
            figures[name] = time_cells(policy, make_batches(policy, batch_size, args.repeats))
    for name, rows in figures.items():
        print_rows(f"{name}, medians of {args.repeats}", rows)
    finish(args.json, figures, bars)


def load(args: argparse.Namespace) -> tuple[Any, Any, LeRobotDataset]:
    """Load the policy, its preprocessor and the dataset."""
    dataset = LeRobotDataset(args.repo_id, root=args.root)
    config = PreTrainedConfig.from_pretrained(args.policy_path)
    config.pretrained_path = args.policy_path
    policy = make_policy(config, ds_meta=dataset.meta).eval()
    return policy, make_pre_post_processors(config, args.policy_path)[0], dataset


def frames(dataset: LeRobotDataset, episodes: range, step: int) -> dict[str, Any]:
    """Collate each episode's frame of a step; an episode that has ended begins again."""
    metadata: Any = dataset.meta.episodes
    items = []
    for number in episodes:
        episode = metadata[number]
        first, end = episode["dataset_from_index"], episode["dataset_to_index"]
        items.append(dataset[first + step % (end - first)])
    return default_collate(items)


@torch.inference_mode()
def time_numbers(policy: Any, batches: list[dict[str, Any]]) -> Rows:
    """Time the whole chunk by the peer and by us, without and with drafts, then only the executed part."""
    backbone, grammar, symbol_ids = policy.backbone, policy.grammar, policy.symbol_ids
    num_executed = policy.config.n_action_steps * policy.action_dim
    linear = LinearDraft(grammar, policy.action_dim)

    def ours(guess: Guess, num_numbers: int = grammar.num_numbers) -> NumbersByUs:
        return NumbersByUs(NumberWriter(backbone, grammar, guess), symbol_ids, num_numbers)

    ways = {
        "generate, xgrammar": NumbersByGenerate(backbone, symbol_ids, grammar),
        "ours, no draft": ours(KnownSymbols(grammar)),
        "ours, linear draft": ours(linear),
        "ours, linear draft, early stop": ours(linear, num_executed),
    }
    prompts = [prompt_of(policy, batch) for batch in batches]
    return compare({name: (way, prompts) for name, way in ways.items()})


def prompt_of(policy: Any, batch: dict[str, Any]) -> Prompt:
    """Return the prompts that the policy answers."""
    rows = policy.prompt(batch).without_padding()
    return Prompt(policy.embed(rows.ids, policy.encode_images(batch)), rows.mask, rows.hidden)


@torch.inference_mode()
def time_cells(policy: SpatialvlaGridPolicy, batches: list[dict[str, Any]]) -> Rows:
    """Time whole chunks by the peer and by us; without a draft, a pass must choose one cell."""
    peer = CellsByGenerate(policy)
    ours = {f"ours, {draft}": (partial(cells_by_us, policy, draft), batches) for draft in DRAFTS}
    figures = compare({"generate": (peer, [peer.inputs(batch) for batch in batches]), **ours})
    assert figures["ours, none"]["passes"] == policy.config.chunk_size * len(policy.grids.groups)
    return figures


def random_policy() -> SpatialvlaGridPolicy:
    """Return a nano policy with random weights and the default groups of the original's actions."""
    torch.manual_seed(0)
    dims = features(RANDOM_DIMS, RANDOM_IMAGE_SIZE, has_state=False)
    config = SpatialvlaGridConfig(vlm_model_name="nano", device="cpu", action_layout="pose", **dims)
    return SpatialvlaGridPolicy(config).eval()


if __name__ == "__main__":
    main()
