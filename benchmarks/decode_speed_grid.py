"""Choosing a chunk's cells: `spatialvla_grid` against transformers' `generate`.

    OMP_NUM_THREADS=1 python benchmarks/decode_speed_grid.py --json decode_speed_grid.json

The peer is the stock PaliGemma of the same weights whose words end with the cells; a logits processor lets
only the slot's cells through. Both see the same random pictures and sentences and must choose the same cells.
Weights are random (nano). Seeing and reading the prompt (prefill) is reported apart; bars are on the rest
(decode). Of the peer's prefill, cutting the pictures and putting the prompt together is left out.
"""

import argparse
import copy
import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any
from unittest.mock import patch

import torch
from decode_speed_compare import Timed, compare, finish, print_rows
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import make_pre_post_processors
from machine import add_machine_arguments, positive, require_idle_machine
from torch import Tensor, nn
from transformers import LogitsProcessor

from lerobot_bomb.vlm.cached_text import CachedText
from lerobot_bomb.vlm.images import crop_and_resize
from lerobot_policy_spatialvla_grid import SpatialvlaGridConfig
from lerobot_policy_spatialvla_grid.modeling_spatialvla_grid import SpatialvlaGridPolicy

MIN_RATIO = 3.0
BATCH_SIZES = 1, 16
# action dims, and whether there is a bar: that of the original, and BOMB's
ACTION_DIMS = {7: True, 4: False}
CAMERAS = "observation.images.workspace", "observation.images.wrist"
IMAGE_SIZE = 128
SENTENCES = "put the black stone on the center", "go", "push the white stone to the left edge"


def main() -> None:
    """Time both, print the tables; exit code 1 where a bar is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--repeats", type=positive, default=20, help="answers of each (default: 20)")
    add_machine_arguments(parser)
    args = parser.parse_args()
    require_idle_machine(args.force)
    logging.disable(logging.WARNING)
    figures: dict[str, Any] = {}
    bars: dict[str, bool] = {}
    with torch.inference_mode():
        for num_dims in ACTION_DIMS:
            policy = make_policy(num_dims)
            for batch_size in BATCH_SIZES:
                name = f"{num_dims} action dims, batch of {batch_size}"
                figures[name] = time_decoding(policy, make_batches(policy, batch_size, args.repeats))
                print_rows(f"{name}, medians of {args.repeats}", figures[name])
                bars |= check(policy, name, figures[name]["ours"])
    print()
    finish(args.json, figures, bars)


def make_policy(num_dims: int) -> SpatialvlaGridPolicy:
    """Nano, random weights, the default groups of so many action dimensions."""
    torch.manual_seed(0)
    picture = PolicyFeature(FeatureType.VISUAL, (3, IMAGE_SIZE, IMAGE_SIZE))
    config = SpatialvlaGridConfig(
        vlm_model_name="nano",
        device="cpu",
        input_features=dict.fromkeys(CAMERAS, picture),
        output_features={"action": PolicyFeature(FeatureType.ACTION, (num_dims,))},
    )
    return SpatialvlaGridPolicy(config).eval()


def make_batches(policy: SpatialvlaGridPolicy, batch_size: int, num_batches: int) -> list[dict[str, Any]]:
    """Preprocessed, the sentences of different lengths."""
    bounds = torch.ones(policy.grids.num_dims)
    preprocessor, _ = make_pre_post_processors(
        policy.config, dataset_stats={"action": {"min": -bounds, "max": bounds}}
    )
    generator = torch.Generator().manual_seed(0)
    shape = batch_size, 3, IMAGE_SIZE, IMAGE_SIZE
    return [
        preprocessor(
            {key: torch.rand(shape, generator=generator) for key in CAMERAS}
            | {"task": [SENTENCES[(first + row) % len(SENTENCES)] for row in range(batch_size)]}
        )
        for first in range(num_batches)
    ]


def time_decoding(policy: SpatialvlaGridPolicy, batches: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Whole chunks by the peer and by us."""
    peer = StockGenerate(policy)
    stock_inputs = [peer.inputs(batch) for batch in batches]
    return compare({"generate": (peer, stock_inputs), "ours": (partial(choose, policy), batches)})


def check(policy: SpatialvlaGridPolicy, name: str, ours: dict[str, float]) -> dict[str, bool]:
    """The bars of one table."""
    num_cells, gain = num_slots(policy), ours["decode_gain"]
    bars = {f"{name}: {ours['passes']:g} passes for {num_cells} cells": ours["passes"] == num_cells}
    if ACTION_DIMS[policy.grids.num_dims]:
        bars[f"{name}: decode {gain:.1f} times faster (bar {MIN_RATIO:g})"] = gain >= MIN_RATIO
    return bars


def num_slots(policy: SpatialvlaGridPolicy) -> int:
    """Cells of a chunk."""
    return policy.config.chunk_size * len(policy.grids.groups)


def choose(policy: SpatialvlaGridPolicy, batch: dict[str, Any]) -> Timed:
    """The policy's own way."""
    started = time.perf_counter()
    with _moments_of_passes() as moments_s:
        cells_BTG = policy._choose(batch, policy.config.chunk_size)
        ended = time.perf_counter()
    return Timed(cells_BTG.flatten(1), moments_s[0] - started, ended - moments_s[0], len(moments_s))


@contextmanager
def _moments_of_passes() -> Iterator[list[float]]:
    moments_s: list[float] = []
    read: Callable[..., Tensor] = CachedText.__call__

    def timed(*args: Any) -> Tensor:
        hidden = read(*args)
        moments_s.append(time.perf_counter())
        return hidden

    with patch.object(CachedText, "__call__", timed):
        yield moments_s


class StockGenerate:
    """Greedy search by transformers' own model, masks and cache; the last words are the cells."""

    def __init__(self, policy: SpatialvlaGridPolicy):
        self._policy = policy
        self._vlm: Any = copy.deepcopy(policy.backbone.vlm)
        words = self._vlm.get_input_embeddings()
        self._first_cell = len(words.weight)
        words.weight = nn.Parameter(torch.cat([words.weight, policy.cell_embedding.weight]))
        head = self._vlm.lm_head
        head.weight = nn.Parameter(torch.cat([head.weight, policy.cell_head.weight]))
        self._vlm.config.text_config.vocab_size = self._vlm.model.vocab_size = len(words.weight)

    def inputs(self, batch: dict[str, Any]) -> dict[str, Tensor]:
        """The policy's prompt, padded on the left, and pictures, as the stock model reads them."""
        policy, prompt = self._policy, self._policy._prompt(batch)
        ids, written = torch.zeros_like(prompt.ids), torch.zeros_like(prompt.ids)
        for row, kept in enumerate(prompt.written):
            ids[row, -int(kept.sum()) :], written[row, -int(kept.sum()) :] = prompt.ids[row, kept], 1
        size, fraction = policy.backbone.image_size, policy.config.crop_fraction
        pixels = [crop_and_resize(batch[key], fraction, size, None) for key in policy._cameras]
        return {
            "input_ids": ids,
            "attention_mask": written,
            "token_type_ids": torch.zeros_like(ids),
            "pixel_values": torch.stack(pixels, dim=1).flatten(0, 1),
        }

    def __call__(self, inputs: dict[str, Tensor]) -> Timed:
        """The cells of a chunk; a pass ends with its logits."""
        slots = _Slots(self._policy, self._first_cell)
        started = time.perf_counter()
        tokens = self._vlm.generate(
            **inputs, max_new_tokens=num_slots(self._policy), do_sample=False, logits_processor=[slots]
        )
        ended, prompt_read = time.perf_counter(), slots.moments_s[0]
        offsets = torch.tensor(self._policy.grids.offsets).repeat(self._policy.config.chunk_size)
        cells_BS = tokens[:, inputs["input_ids"].shape[1] :] - self._first_cell - offsets
        return Timed(cells_BS, prompt_read - started, ended - prompt_read, len(slots.moments_s))


class _Slots(LogitsProcessor):
    """Lets only the slot's cells through; knows when each pass was done."""

    def __init__(self, policy: SpatialvlaGridPolicy, first_cell: int):
        self.moments_s: list[float] = []
        cells = zip(policy.grids.offsets, policy.grids.num_cells, strict=True)
        self._cells = [slice(first_cell + first, first_cell + first + count) for first, count in cells]

    def __call__(self, input_ids: Tensor, scores: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        cells = self._cells[len(self.moments_s) % len(self._cells)]
        self.moments_s.append(time.perf_counter())
        masked = torch.full_like(scores, -torch.inf)
        masked[:, cells] = scores[:, cells]
        return masked


if __name__ == "__main__":
    main()
