"""Precision of the output head in a vla0_smol's answers in bfloat16: ties, and rows as in float32.

    python benchmarks/bfloat16_head.py --policy.path=CHECKPOINT --dataset.root=DATASET [--frames=256]

Frames are spread evenly over a recording. With `head in bfloat16` the output head runs in the policy's own
precision, as in a plain autocast pass. A tie is a choice whose two likeliest symbols have the same logit.
"""

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from unittest.mock import patch

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset
from lerobot.policies import make_pre_post_processors
from machine import add_machine_arguments, positive, require_idle_machine, write_figures
from torch import Tensor
from torch.nn.functional import linear

from lerobot_bomb.decoding import decoder
from lerobot_bomb.vlm import backbone
from lerobot_policy_vla0_smol.configuration_vla0_smol import Vla0SmolConfig
from lerobot_policy_vla0_smol.modeling_vla0_smol import Vla0SmolPolicy

Likeliest = Callable[[Tensor], tuple[Tensor, Tensor]]


def main() -> None:
    """Print one line for each way to run the head."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--policy.path", dest="path", required=True)
    parser.add_argument("--dataset.root", dest="root", type=Path, required=True)
    parser.add_argument("--frames", type=positive, default=256)
    add_machine_arguments(parser)
    args = parser.parse_args()
    require_idle_machine(args.force)
    config = PreTrainedConfig.from_pretrained(args.path)
    assert isinstance(config, Vla0SmolConfig)
    config.device = "cpu"
    policy = Vla0SmolPolicy.from_pretrained(args.path, config=config).eval()
    preprocess, _ = make_pre_post_processors(config, args.path)
    dataset = LeRobotDataset("any/name", root=args.root)
    frames = torch.linspace(0, len(dataset) - 1, args.frames).round().int().tolist()
    batch = preprocess(torch.utils.data.default_collate([dataset[frame] for frame in frames]))
    exact = policy.predict_action_chunk(batch).flatten(1)
    policy.config.dtype = "bfloat16"
    figures = {}
    for name, way in {"head in bfloat16": rounded_head, "head in float32": nullcontext}.items():
        counts = torch.zeros(3, dtype=torch.int64)
        with way(), patch.object(decoder, "likeliest", counting(decoder.likeliest, counts)):
            answers = policy.predict_action_chunk(batch).flatten(1)
        choices, ties, lower = counts.tolist()
        same = int((answers == exact).all(dim=1).sum())
        figures[name] = {"choices": choices, "ties": ties, "lower": lower, "rows": len(exact), "same": same}
        print(
            f"{name}: {ties} of {choices} digit choices are ties ({100 * ties / choices:.1f} %), "
            f"{lower} of them taken by the lower digit; {same} of {len(exact)} rows as in float32"
        )
    write_figures(args.json, figures)


def counting(likeliest: Likeliest, counts: Tensor) -> Likeliest:
    """The function, which also adds up choices between digits, ties, and ties that the lower digit takes."""

    def counted(logits: Tensor) -> tuple[Tensor, Tensor]:
        choice, best = likeliest(logits)
        is_open = (logits > -torch.inf).sum(dim=-1) > 1
        is_best = logits == best[..., None]
        is_tie = is_open & (is_best.sum(dim=-1) > 1)
        is_lower = is_tie & (choice == is_best.int().argmax(dim=-1))
        counts.add_(torch.stack([is_open.sum(), is_tie.sum(), is_lower.sum()]))
        return choice, best

    return counted


@contextmanager
def rounded_head() -> Iterator[None]:
    """The output head under the policy's own autocast."""
    with patch.object(backbone, "exact_linear", lambda hidden, weight: linear(hidden, weight)):
        yield


if __name__ == "__main__":
    main()
