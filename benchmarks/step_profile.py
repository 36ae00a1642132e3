"""Profile of one training step and of one evaluation step.

    OMP_NUM_THREADS=1 python benchmarks/step_profile.py --policy.type=vla0_smol --json step_profile.json

The policy is the recipe of configs/overfit_TYPE.yaml with fresh weights, on demonstrations recorded for
the purpose. Stages are medians over --repeats steps.
"""

import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import draccus
import torch
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.factory import make_dataset
from lerobot.envs import make_env, make_env_config, make_env_pre_post_processors, preprocess_observation
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.utils.import_utils import register_third_party_plugins
from machine import make_parser, parse_on_idle_machine, positive, write_figures
from overfit import IMAGE_SIZE, record
from recipes import POLICY_TYPES, read_recipe
from torch.utils.data import default_collate

from lerobot_bomb.tables import print_table


class Stages:
    """Durations in seconds of named stages."""

    def __init__(self) -> None:
        self.runs: dict[str, list[float]] = {}

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        started = time.perf_counter()
        yield
        self.runs.setdefault(name, []).append(time.perf_counter() - started)

    def medians_ms(self) -> dict[str, float]:
        return {name: 1e3 * statistics.median(runs) for name, runs in self.runs.items()}


def main() -> None:
    """Profile both steps and print where their time goes."""
    parser = make_parser(__doc__)
    parser.add_argument("--policy.type", dest="policy_type", required=True, choices=POLICY_TYPES)
    steps = "training steps and predictions (default: 20)"
    parser.add_argument("--repeats", type=positive, default=20, help=steps)
    args = parse_on_idle_machine(parser)
    register_third_party_plugins()
    with tempfile.TemporaryDirectory() as folder:
        record(Path(folder) / "dataset")
        cfg = recipe(args.policy_type, Path(folder) / "dataset")
        dataset: Any = make_dataset(cfg)
    assert cfg.policy is not None
    torch.manual_seed(0)
    policy = make_policy(cfg.policy, ds_meta=dataset.meta)
    processors = make_pre_post_processors(cfg.policy, dataset_stats=dataset.meta.stats)

    print(f"\ntraining step, batch of {cfg.batch_size}")
    train = profile_training(cfg, policy, processors[0], dataset, args.repeats)
    print("\nevaluation step, batch of 1")
    evaluation = profile_evaluation(cfg, policy, processors, args.repeats)
    figures = {"policy": args.policy_type, "training_ms": train, "evaluation_ms": evaluation}
    write_figures(args.json, figures)


def recipe(policy_type: str, dataset: Path) -> TrainPipelineConfig:
    """Read configs/overfit_TYPE.yaml for this dataset, as `lerobot-train` does."""
    values = read_recipe("overfit", policy_type)
    values["dataset"] |= {"root": str(dataset), "video_backend": "pyav"}
    return draccus.decode(TrainPipelineConfig, values)


def profile_training(
    cfg: TrainPipelineConfig, policy: Any, preprocessor: Callable, dataset: Any, repeats: int
) -> dict[str, float]:
    """Time the stages of a training step, in milliseconds, as of `lerobot-train --num_workers=0`."""
    optimizer: Any = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    policy.train()
    generator = torch.Generator().manual_seed(0)
    batches = [
        torch.randint(len(dataset), (cfg.batch_size,), generator=generator).tolist() for _ in range(repeats)
    ]

    def step(indices: list[int], stage: Stages) -> None:
        with stage("read frames"):
            items = [dataset[index] for index in indices]
        with stage("collate, preprocess"):
            batch = preprocessor(default_collate(items))
        with stage("forward"):
            loss, _ = policy.forward(batch)
        with stage("backward"):
            loss.backward()
        with stage("optimiser"):
            torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
            optimizer.step()
            optimizer.zero_grad()

    for indices in batches[:3]:
        step(indices, Stages())
    stages = Stages()
    for indices in batches:
        step(indices, stages)
    medians = stages.medians_ms()
    print_stages(medians, len(batches))
    return medians


def profile_evaluation(
    cfg: TrainPipelineConfig, policy: Any, processors: tuple[Any, Any], repeats: int
) -> dict[str, float]:
    """Time the stages of an evaluation step, in milliseconds, as of `lerobot-eval`."""
    env_config = make_env_config("bomb", image_size=IMAGE_SIZE)
    env: Any = make_env(env_config, n_envs=1)["place"][0]
    env_preprocessor, _ = make_env_pre_post_processors(env_cfg=env_config, policy_cfg=cfg.policy)
    preprocessor, postprocessor = processors
    stages = Stages()
    policy.eval()
    policy.reset()
    observation, _ = env.reset(seed=0)
    num_action_steps = policy.config.n_action_steps  # one step in so many predicts
    num_steps = num_action_steps * repeats
    for step in range(num_steps):
        with stages("to tensors, preprocess"):
            batch: dict[str, Any] = preprocess_observation(observation)
            batch["task"] = list(env.call("task_description"))
            batch = preprocessor(env_preprocessor(batch))
        name = (
            "select_action that predicts" if step % num_action_steps == 0 else "select_action from the queue"
        )
        with stages(name), torch.inference_mode():
            action = policy.select_action(batch)
        with stages("postprocess"):
            action = postprocessor(action).numpy()
        with stages("environment: physics, two cameras"):
            observation, *_ = env.step(action)
        with stages("image for the video (first 10 episodes only)"):
            env.call("render")
    medians = stages.medians_ms()
    print_stages(medians, num_steps)
    per_step_ms = 1e3 * sum(map(sum, stages.runs.values())) / num_steps
    print(f"a step on average, as one in {num_action_steps} predicts: {per_step_ms:.1f} ms")
    medians["a step on average"] = per_step_ms
    env.close()
    return medians


def print_stages(medians_ms: dict[str, float], repeats: int) -> None:
    """Print a table of the stages."""
    total = sum(medians_ms.values())
    rows = [[name, f"{ms:.1f}", f"{ms / total:.0%}"] for name, ms in medians_ms.items()]
    print_table(["stage", f"ms (median, {repeats} steps)", "share"], [*rows, ["sum", f"{total:.1f}", ""]])


if __name__ == "__main__":
    main()
