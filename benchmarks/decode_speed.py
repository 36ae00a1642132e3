"""Speed of decoding an answer: ours against transformers' `generate` with xgrammar's logits processor.

    python benchmarks/decode_speed.py --policy.path=CHECKPOINT \
        --dataset.repo_id=USER/pusht --dataset.root=pusht --json decode_speed.json

Both have the same weights, read the same prompt embeddings and must write the same numbers. The prompts are
those of a trained nano `vla0_smol` on frames of held-out episodes. Reading the prompt (prefill) is reported
separately; the bars are on the decoding that follows.
"""

import logging
from dataclasses import replace

import torch
from decode_speed_works import Episodes, add_episode_arguments, compare, ours, peer
from lerobot.utils.import_utils import register_third_party_plugins
from machine import (
    Rows,
    add_machine_arguments,
    finish,
    make_parser,
    positive,
    print_rows,
    require_idle_machine,
)

from lerobot_bomb.decoding.draft import KnownSymbols

MIN_RATIO = 4.0
BATCH_SIZES = 1, 16


def main() -> None:
    """Time answers and print the tables; exit with code 1 if a bar is missed."""
    parser = make_parser(__doc__)
    add_episode_arguments(parser, "vla0_smol")
    parser.add_argument("--repeats", type=positive, default=20, help="answers of each (default: 20)")
    add_machine_arguments(parser)
    args = parser.parse_args()
    require_idle_machine(args.force)
    logging.disable(logging.WARNING)
    register_third_party_plugins()
    episodes = Episodes(args)
    figures, bars = {}, {}
    with torch.inference_mode():
        for batch_size in BATCH_SIZES:
            name = f"nano, batch of {batch_size}"
            figures[name] = time_answers(episodes, batch_size, args.repeats)
            print_rows(f"{name}, medians of {args.repeats}", figures[name])
            gain = figures[name]["ours, linear draft"]["decode_gain"]
            bars[f"{name}: decode {gain:.1f} times faster (bar {MIN_RATIO})"] = gain >= MIN_RATIO
    finish(args.json, figures, bars)


def time_answers(episodes: Episodes, batch_size: int, repeats: int) -> Rows:
    """Time the whole chunk by the peer and by us, without and with drafts, then only the executed part."""
    works = episodes.works(batch_size, repeats)
    whole = [replace(work, stop_after=work.grammar.num_numbers) for work in works]
    undrafted = [replace(work, guess=KnownSymbols(work.grammar)) for work in whole]
    return compare(
        {
            "generate, xgrammar": (peer, whole),
            "ours, no draft": (ours, undrafted),
            "ours, linear draft": (ours, whole),
            "ours, linear draft, early stop": (ours, works),
        }
    )


if __name__ == "__main__":
    main()
