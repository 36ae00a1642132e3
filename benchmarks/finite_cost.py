"""Cost of looking for NaN and infinite numbers, in CPU time, in a training step and in a predicted chunk.

    python benchmarks/finite_cost.py

Nano models on images of 256x256 pixels, as recordings have; a real model's step takes longer and its checks
do not. The checks of a batch are timed alone, twice: on a CPU the policy's readers look again at what the
processor step has seen.
"""

import time
from collections.abc import Callable
from functools import partial
from statistics import median
from typing import Any

import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.factory import get_policy_class, make_policy_config, make_pre_post_processors
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_bomb.finite import require_finite_batch

BATCH, SIZE, DIMS, REPEATS = 8, 256, 4, 5
CAMERAS = "observation.images.workspace", "observation.images.wrist"
STATE, ACTION = "observation.state", "action"


def main() -> None:
    """Print a line for each policy type."""
    register_third_party_plugins()
    for policy_type in ("vla0_smol", "spatialvla_grid", "fdvla"):
        measure(policy_type)


def measure(policy_type: str) -> None:
    """Print a policy type's line."""
    torch.manual_seed(0)
    inputs = {key: PolicyFeature(FeatureType.VISUAL, (3, SIZE, SIZE)) for key in CAMERAS}
    config: Any = make_policy_config(policy_type, vlm_model_name="nano", device="cpu", dtype="float32")
    config.input_features = {**inputs, STATE: PolicyFeature(FeatureType.STATE, (DIMS,))}
    config.output_features = {ACTION: PolicyFeature(FeatureType.ACTION, (DIMS,))}
    ends = {"min": -1.0, "max": 1.0, "mean": 0.0, "std": 1.0, "q01": -1.0, "q99": 1.0}
    of_key = {name: torch.full((DIMS,), value) for name, value in ends.items()}
    statistics = {STATE: of_key, ACTION: of_key}
    policy: Any = get_policy_class(policy_type)(config)
    preprocessor, _ = make_pre_post_processors(config, dataset_stats=statistics)
    batch = {key: torch.rand(BATCH, 3, SIZE, SIZE) for key in CAMERAS}
    batch |= {STATE: torch.rand(BATCH, DIMS), ACTION: torch.rand(BATCH, config.chunk_size, DIMS)}
    task = {"task": BATCH * ["go"]}
    alone = {key: values[:1] for key, values in batch.items() if key != ACTION}

    def train() -> None:
        policy.train()
        policy(preprocessor({**batch, **task}))[0].backward()

    def predict() -> None:
        policy.predict_action_chunk(preprocessor({**alone, "task": ["go"]}))

    step, chunk = milliseconds(train), milliseconds(predict)
    of_step, of_chunk = (2 * milliseconds(partial(require_finite_batch, of, {})) for of in (batch, alone))
    print(
        f"{policy_type:16} step {step:8.1f} ms, checks {of_step:.2f} ms = {100 * of_step / step:.2f} %; "
        f"chunk {chunk:8.1f} ms, checks {of_chunk:.2f} ms = {100 * of_chunk / chunk:.2f} %",
        flush=True,
    )


def milliseconds(work: Callable[[], None]) -> float:
    """Median CPU time of a call."""
    times = []
    for _ in range(REPEATS + 1):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return 1000 * median(times[1:])


if __name__ == "__main__":
    main()
