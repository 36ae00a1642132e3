"""Training steps of nano ``vla0_smol`` against the same model fed by strings and the Hugging Face processor.

    OMP_NUM_THREADS=1 python benchmarks/train_speed.py --json train_speed.json

Both read the same frames, weights and optimiser. The peer is the usual way to fine-tune a SmolVLM: every
sample's numbers are joined to a text, a chat template puts the prompt together, ``SmolVLMProcessor`` (Pillow,
no tiling) resizes the images and tokenizes, labels are found by searching for the answer, and the stock
``SmolVLMForConditionalGeneration`` computes the loss. It runs twice: with `do_resize=False`, which gives the
pixels of ours, and as the processor is shipped, which enlarges images to four times the model's size first.
Before anything is timed, the first must have the loss of ours. Needs `num2words`, as that processor does.
"""

import argparse
import copy
import logging
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from lerobot.datasets.factory import make_dataset
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.utils.import_utils import register_third_party_plugins
from machine import add_machine_arguments, positive, require_idle_machine, write_figures
from overfit import record
from step_profile import Stages, print_stages, recipe
from torch import Tensor
from torch.utils.data import default_collate
from train_speed_strings import StringPath

from lerobot_bomb.tables import print_table
from lerobot_bomb.vlm.images import crop, resized_pixels

MIN_RATIO = 1.5
MAX_PREPROCESSING = 0.05  # of a step
MAX_LOSS_DIFFERENCE = 1e-3
OUR_PIXELS = "strings, do_resize=False"
AS_SHIPPED = "strings, processor as shipped"
CROP = "lerobot_policy_vla0_smol.modeling_vla0_smol.crop"
RESIZE = "lerobot_bomb.vlm.backbone.resized_pixels"
PREPROCESSING = ("collate", "tokenize, normalise", "crop and resize", "prompt and numbers")


def main() -> None:
    """Check that the losses agree, time the steps in turn; exit code 1 where a bar is missed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=positive, default=40, help="steps of each (default: 40)")
    parser.add_argument("--batch_size", type=positive, default=16, help="samples a step (default: 16)")
    add_machine_arguments(parser)
    args = parser.parse_args()
    require_idle_machine(args.force)
    logging.disable(logging.WARNING)  # transformers repeats one for every sample
    register_third_party_plugins()
    with tempfile.TemporaryDirectory() as folder:
        record(Path(folder) / "dataset")
        policy, preprocessor, batches = prepare(Path(folder) / "dataset", args.repeats, args.batch_size)
    paths = {
        "tensors (ours)": TensorPath(policy, preprocessor),
        OUR_PIXELS: StringPath(copy.deepcopy(policy), preprocessor, do_resize=False),
        AS_SHIPPED: StringPath(copy.deepcopy(policy), preprocessor, do_resize=True),
    }
    differences = check_losses(paths, batches[0])
    seconds = measure(paths, batches)
    figures = report(seconds, args.batch_size)
    shares = profile_stages(policy, preprocessor, batches)
    write_figures(args.json, {"loss_differences": differences, "paths": figures, "stages": shares})
    is_fast = figures[AS_SHIPPED]["ours_gains"] >= MIN_RATIO
    sys.exit(0 if is_fast and shares["preprocessing_share"] < MAX_PREPROCESSING else 1)


def prepare(dataset_folder: Path, repeats: int, batch_size: int) -> tuple[Any, Callable, list[list[dict]]]:
    """Policy of configs/overfit_vla0_smol.yaml with state, preprocessor, batches of items in memory."""
    cfg: Any = recipe("vla0_smol", dataset_folder)
    cfg.policy.use_state = True
    # what the peer does not have: hidden numbers, and padded steps without loss
    cfg.policy.mask_max_fraction = 0.0
    cfg.policy.loss_on_padded_actions = True
    dataset: Any = make_dataset(cfg)
    torch.manual_seed(0)
    policy = make_policy(cfg.policy, ds_meta=dataset.meta)
    preprocessor, _ = make_pre_post_processors(cfg.policy, dataset_stats=dataset.meta.stats)
    generator = torch.Generator().manual_seed(0)
    indices = torch.randint(len(dataset), (repeats, batch_size), generator=generator).tolist()
    items = {index: dataset[index] for row in indices for index in row}
    return policy, preprocessor, [[items[index] for index in row] for row in indices]


class TensorPath:
    """Loss as the policy computes it."""

    def __init__(self, policy: Any, preprocessor: Callable):
        self.policy, self.preprocessor = policy, preprocessor

    def loss(self, items: list[dict]) -> Tensor:
        return self.policy(self.preprocessor(default_collate(items)))[0]


def check_losses(paths: dict[str, Any], items: list[dict]) -> dict[str, float]:
    """Return each loss' difference from ours, centre crop; the peer with our pixels must agree."""
    losses = {}
    for name, path in paths.items():
        path.policy.eval()
        with torch.no_grad():
            losses[name] = path.loss(items).item()
        path.policy.train()
    ours, *_ = losses.values()
    differences = {name: abs(loss - ours) for name, loss in losses.items()}
    print("\n".join(f"loss on the same batch, {name}: {loss:.6f}" for name, loss in losses.items()))
    if differences[OUR_PIXELS] > MAX_LOSS_DIFFERENCE:
        raise SystemExit(f"The losses differ by more than {MAX_LOSS_DIFFERENCE}: not the same model or data.")
    return differences


def measure(paths: dict[str, Any], batches: list[list[dict]]) -> dict[str, list[float]]:
    """Seconds of whole training steps, in turn."""
    steps = {name: make_step(path) for name, path in paths.items()}
    for step in [*steps.values()] * 2:
        step(batches[0])
    seconds: dict[str, list[float]] = {name: [] for name in steps}
    for items in batches:
        for name, step in steps.items():
            started = time.perf_counter()
            step(items)
            seconds[name].append(time.perf_counter() - started)
    return seconds


def make_step(path: Any) -> Callable[[list[dict]], None]:
    """One optimisation step, as `lerobot-train` takes it."""
    optimizer: Any = path.policy.config.get_optimizer_preset().build(path.policy.get_optim_params())

    def step(items: list[dict]) -> None:
        path.loss(items).backward()
        torch.nn.utils.clip_grad_norm_(path.policy.parameters(), 1.0)
        optimizer.step()
        optimizer.zero_grad()

    return step


def report(seconds: dict[str, list[float]], batch_size: int) -> dict[str, dict[str, float]]:
    """Print samples per second and what ours gains."""
    medians = {name: statistics.median(runs) for name, runs in seconds.items()}
    ours, *_ = medians.values()
    figures = {
        name: {"step_ms": 1e3 * median, "samples_per_s": batch_size / median, "ours_gains": median / ours}
        for name, median in medians.items()
    }
    print_table(
        [f"step, batch of {batch_size}", "ms (median)", "samples/s", f"ours gains (bar {MIN_RATIO})"],
        [[name, *(f"{value:.2f}" for value in row.values())] for name, row in figures.items()],
    )
    return figures


def profile_stages(policy: Any, preprocessor: Callable, batches: list[list[dict]]) -> dict[str, float]:
    """Milliseconds of the stages of our step; preprocessing is all that comes before the network."""
    optimizer: Any = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    stages = Stages()
    inside: dict[str, float] = {}

    def timed(name: str, call: Callable) -> Callable:
        def run(*args: Any) -> Any:
            started = time.perf_counter()
            result = call(*args)
            inside[name] = inside.get(name, 0.0) + time.perf_counter() - started
            return result

        return run

    with ExitStack() as stack:
        stack.enter_context(patch(CROP, timed("crop and resize", crop)))
        stack.enter_context(patch(RESIZE, timed("crop and resize", resized_pixels)))
        for method in ("_prompt", "_numbers", "_answer"):
            call = timed("prompt and numbers", getattr(policy, method))
            stack.enter_context(patch.object(policy, method, call))
        for items in batches:
            with stages("collate"):
                batch = default_collate(items)
            with stages("tokenize, normalise"):
                batch = preprocessor(batch)
            inside.clear()
            started = time.perf_counter()
            loss, _ = policy(batch)
            forward_s = time.perf_counter() - started
            for name, duration in {**inside, "network, loss": forward_s - sum(inside.values())}.items():
                stages.runs.setdefault(name, []).append(duration)
            with stages("backward"):
                loss.backward()
            with stages("optimiser"):
                torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
                optimizer.step()
                optimizer.zero_grad()
    medians = stages.medians_ms()
    print("\nwhere our step goes")
    print_stages(medians, len(batches))
    share = sum(medians[name] for name in PREPROCESSING) / sum(medians.values())
    print(f"preprocessing: {share:.1%} of a step (bar {MAX_PREPROCESSING:.0%})")
    return {**medians, "preprocessing_share": share}


if __name__ == "__main__":
    main()
