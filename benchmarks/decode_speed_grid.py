"""Speed of choosing a chunk's cells: `spatialvla_grid` against transformers' `generate`.

    python benchmarks/decode_speed_grid.py --policy.path=CHECKPOINT --dataset.repo_id=USER/pusht \
        --dataset.root=pusht --json decode_speed_grid.json

The peer is the stock PaliGemma with the same weights. The cells are its last words, and a logits processor
lets only those of the slot through. Both see the same inputs and must choose the same cells: a trained nano
policy sees frames of held-out episodes; one with random weights sees random images and instructions, where a
draft has little to use. Reading images and prompt (prefill) is reported separately; the bars are on the
decoding. The peer's prefill excludes cropping the images and building the prompt.
"""

import copy
import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any
from unittest.mock import patch

import torch
from decode_speed_works import Episodes, Timed, add_episode_arguments, compare
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
from random_policies import features, make_batches
from torch import Tensor, nn
from transformers import LogitsProcessor

from lerobot_bomb.decoding.kv_cache import CachedText
from lerobot_bomb.vlm.images import crop, resized_pixels
from lerobot_policy_spatialvla_grid import SpatialvlaGridConfig
from lerobot_policy_spatialvla_grid.configuration_spatialvla_grid import DRAFTS
from lerobot_policy_spatialvla_grid.modeling_spatialvla_grid import SpatialvlaGridPolicy

MIN_RATIO = 3.0
BATCH_SIZES = 1, 16
ACTION_DIMS = 7, 4  # of the original, and BOMB's
IMAGE_SIZE = 128


def main() -> None:
    """Time the policy and the peer, print the tables; exit with code 1 if a bar is missed."""
    parser = make_parser(__doc__)
    add_episode_arguments(parser, "spatialvla_grid")
    parser.add_argument("--repeats", type=positive, default=20, help="answers of each (default: 20)")
    add_machine_arguments(parser)
    args = parser.parse_args()
    require_idle_machine(args.force)
    logging.disable(logging.WARNING)
    register_third_party_plugins()
    episodes = Episodes(args)
    figures: dict[str, Any] = {}
    bars: dict[str, bool] = {}
    with torch.inference_mode():
        for batch_size in BATCH_SIZES:
            trained = episodes.batches(batch_size, args.repeats)
            name = f"trained, batch of {batch_size}"
            figures[name] = time_decoding(name, *trained, bars)
            gain = figures[name]["ours, repeat"]["decode_gain"]
            bars[f"{name}: decode {gain:.1f} times faster (bar {MIN_RATIO:g})"] = gain >= MIN_RATIO
        for num_dims in ACTION_DIMS:
            policy = make_policy(num_dims)
            for batch_size in BATCH_SIZES:
                name = f"random, {num_dims} action dims, batch of {batch_size}"
                batches = make_batches(policy, batch_size, args.repeats)
                figures[name] = time_decoding(name, policy, batches, bars)
    print()
    finish(args.json, figures, bars)


def make_policy(num_dims: int) -> SpatialvlaGridPolicy:
    """Return a nano policy with random weights and the default groups of this many action dimensions."""
    torch.manual_seed(0)
    config = SpatialvlaGridConfig(
        vlm_model_name="nano",
        device="cpu",
        action_layout="pose" if num_dims == 7 else None,
        **features(num_dims, IMAGE_SIZE, has_state=False),
    )
    return SpatialvlaGridPolicy(config).eval()


def time_decoding(
    name: str, policy: SpatialvlaGridPolicy, batches: list[dict[str, Any]], bars: dict[str, bool]
) -> Rows:
    """Time whole chunks by the peer and by us."""
    peer = StockGenerate(policy)
    runs = {f"ours, {draft}": (partial(choose, policy, draft), batches) for draft in DRAFTS}
    figures = compare({"generate": (peer, [peer.inputs(batch) for batch in batches]), **runs})
    print_rows(f"{name}, medians of {len(batches)}", figures)
    num_cells, num_passes = num_slots(policy), figures["ours, none"]["passes"]
    bars[f"{name}: {num_passes:g} passes for {num_cells} cells"] = num_passes == num_cells
    return figures


def num_slots(policy: SpatialvlaGridPolicy) -> int:
    """Return the number of cells in a chunk."""
    return policy.config.chunk_size * len(policy.grids.groups)


def choose(policy: SpatialvlaGridPolicy, draft: str, batch: dict[str, Any]) -> Timed:
    """Choose and time a chunk's cells with the policy's own decoder."""
    policy._decoder.drafted = draft != "none"
    started = time.perf_counter()
    with _moments_of_passes() as moments_s:
        cells_BTG = policy.choose(batch, policy.config.chunk_size)
        ended = time.perf_counter()
    return Timed(cells_BTG.flatten(1), moments_s[0] - started, ended - moments_s[0], len(moments_s))


@contextmanager
def _moments_of_passes() -> Iterator[list[float]]:
    moments_s: list[float] = []
    read: Callable[..., Tensor] = CachedText.read

    def timed(*args: Any) -> Tensor:
        hidden = read(*args)
        moments_s.append(time.perf_counter())
        return hidden

    with patch.object(CachedText, "read", timed):
        yield moments_s


class StockGenerate:
    """Greedy search by transformers' own model, masks and cache; its last words are the cells."""

    def __init__(self, policy: SpatialvlaGridPolicy):
        self._policy = policy
        self._vlm: Any = copy.deepcopy(policy.backbone.vlm)
        words = self._vlm.get_input_embeddings()
        self._first_cell = len(words.weight)
        words.weight = nn.Parameter(torch.cat([words.weight, policy.cell_embedding.weight]))
        head = self._vlm.lm_head
        head.weight = nn.Parameter(torch.cat([head.weight, policy.cell_head.weight]))
        # what a policy without depth learned to add to every patch
        size = policy.ego3d.lattice_size
        no_depth_E = policy.ego3d(torch.full((1, size, size, 3), torch.nan))[0, 0]
        norm = self._vlm.model.vision_tower.get_submodule("vision_model.post_layernorm")
        norm.bias = nn.Parameter(norm.bias + no_depth_E)
        self._vlm.config.text_config.vocab_size = self._vlm.model.vocab_size = len(words.weight)

    def inputs(self, batch: dict[str, Any]) -> dict[str, Tensor]:
        """Return the policy's prompt, padded on the left, and its images, as the stock model reads them."""
        policy, prompt = self._policy, self._policy.prompt(batch)
        ids, written = torch.zeros_like(prompt.ids), torch.zeros_like(prompt.ids)
        for row, kept in enumerate(prompt.mask):
            ids[row, -int(kept.sum()) :], written[row, -int(kept.sum()) :] = prompt.ids[row, kept], 1
        size, fraction = policy.backbone.image_size, policy.config.crop_fraction
        pixels = [resized_pixels(crop(batch[key], fraction, None), size) for key in policy._cameras]
        return {
            "input_ids": ids,
            "attention_mask": written,
            "token_type_ids": torch.zeros_like(ids),
            "pixel_values": torch.stack(pixels, dim=1).flatten(0, 1),
        }

    def __call__(self, inputs: dict[str, Tensor]) -> Timed:
        """Choose and time the cells of a chunk; a pass ends with its logits."""
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
    """Lets only the slot's cells through; records when each pass ended."""

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
