"""Stock trainings in several processes, one after the other in the same ones, which saves imports.

As a script: reads a list of `Training`s in the folder given; every process writes its losses beside it.
"""

import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock
from zlib import crc32

import torch
from torch import Tensor, distributed

NUM_PROCESSES = 2
TIMEOUT_S = 600  # against hangs


@dataclass(frozen=True)
class Training:
    """Flags of `lerobot-train`; ``{rank}`` in them is the number of the process."""

    flags: list[str]
    is_sharded: bool = False  # by FSDP, otherwise every process has the whole policy


@dataclass(frozen=True)
class Seen:
    """The losses of every training's steps, of each process, and all that was printed."""

    losses: list[list[list[float]]]  # by process, training, step
    text: str

    def mean_losses(self, training: int) -> list[float]:
        """Average the losses over the processes, as LeRobot logs them."""
        return [
            sum(step_losses) / len(step_losses)
            for step_losses in zip(*(losses[training] for losses in self.losses), strict=True)
        ]


def in_processes(trainings: Sequence[Training], folder: Path) -> Seen:
    """Run them in order; raises what they print where one fails."""
    (folder / "trainings.json").write_text(json.dumps([asdict(training) for training in trainings]))
    ended = subprocess.run(
        [sys.executable, __file__, str(folder)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    assert ended.returncode == 0, ended.stdout
    ranks = range(NUM_PROCESSES)
    return Seen([json.loads((folder / f"losses{rank}.json").read_text()) for rank in ranks], ended.stdout)


@contextmanager
def seen_losses() -> Iterator[list[float]]:
    """Collect the loss of every step of `lerobot-train` in this process from now on."""
    from lerobot.scripts import lerobot_train

    found, update_policy = [], lerobot_train.update_policy

    def update(*args: Any, **kwargs: Any) -> Any:
        tracker, metrics = update_policy(*args, **kwargs)
        found.append(tracker.metrics["loss"].val)
        return tracker, metrics

    with mock.patch.object(lerobot_train, "update_policy", update):
        yield found


@contextmanager
def draws_by_sample() -> Iterator[None]:
    """Let `fdvla` draw time and noise as a function of the sample, whatever batch it is in."""
    from lerobot_bomb.flow.path import PathPoint
    from lerobot_policy_bomb.fdvla.modeling_fdvla import FdvlaPolicy

    draw = FdvlaPolicy._draw_point

    def draw_each(policy: FdvlaPolicy, actions_BKD: Tensor) -> PathPoint:
        points = []
        for actions_1KD in actions_BKD.split(1):
            policy.generator.manual_seed(crc32(actions_1KD.numpy().tobytes()))
            points.append(vars(draw(policy, actions_1KD)))
        return PathPoint(**{name: torch.cat([point[name] for point in points]) for name in points[0]})

    with mock.patch.object(FdvlaPolicy, "_draw_point", draw_each):
        yield


@contextmanager
def sharded_on_cpu() -> Iterator[None]:
    """Let accelerate shard the policy by FSDP, which it does on accelerators only."""
    import accelerate
    from accelerate.state import PartialState
    from accelerate.utils import DistributedType, FullyShardedDataParallelPlugin
    from lerobot.scripts import lerobot_train
    from torch.distributed import fsdp
    from torch.utils._pytree import tree_map_only

    def make(**kwargs: Any) -> accelerate.Accelerator:
        accelerator = usual(**kwargs)
        # FSDP wants a device without index
        state = {"distributed_type": DistributedType.FSDP, "device": torch.device("cpu")}
        changed.enter_context(mock.patch.dict(PartialState._shared_state, state))
        plugin = FullyShardedDataParallelPlugin(
            auto_wrap_policy="transformer_based_wrap", use_orig_params=True
        )
        vars(accelerator.state).update(state, fsdp_plugin=plugin)
        return accelerator

    def gather(*args: Any) -> Any:
        return tree_map_only(Tensor, Tensor.clone, usual_gather(*args))

    # what is moved to the CPU is copied, unless it is there already; its memory is given back or shared
    stay = partial(fsdp.FullStateDictConfig, offload_to_cpu=False)
    usual, usual_gather = accelerate.Accelerator, lerobot_train.gather_fsdp_state_dicts
    with ExitStack() as changed:
        changed.enter_context(mock.patch.object(accelerate, "Accelerator", make))
        changed.enter_context(mock.patch.object(fsdp, "FullStateDictConfig", lambda **_: stay()))
        changed.enter_context(mock.patch.object(lerobot_train, "gather_fsdp_state_dicts", gather))
        yield


def train(folder: Path) -> None:
    """Run the file's trainings in each process."""
    from accelerate.state import AcceleratorState
    from lerobot.scripts import lerobot_train

    rank, all_losses = distributed.get_rank(), []
    for training in json.loads((folder / "trainings.json").read_text()):
        sys.argv = ["lerobot-train", *(flag.replace("{rank}", str(rank)) for flag in training["flags"])]
        sharding = sharded_on_cpu() if training["is_sharded"] else nullcontext()
        with seen_losses() as losses, draws_by_sample(), sharding:
            lerobot_train.main()
        AcceleratorState._reset_state()
        all_losses.append(losses)
    (folder / f"losses{rank}.json").write_text(json.dumps(all_losses))


def main(folder: Path) -> None:
    """Import once, then fork the processes."""
    from accelerate import debug_launcher
    from lerobot.scripts import lerobot_train  # noqa: F401

    import lerobot_policy_bomb.fdvla.modeling_fdvla  # noqa: F401

    debug_launcher(train, (folder,), NUM_PROCESSES)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
