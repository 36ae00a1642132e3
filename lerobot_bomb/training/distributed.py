"""Processes that train one policy, each on batches of its own; their gradients are averaged."""

from collections import defaultdict
from pathlib import Path
from typing import Any

from torch import Tensor, distributed, nn


def process_number() -> int:
    """From 0; where there is one process only, it."""
    return distributed.get_rank() if _are_several() else 0


def weighed(mean: Tensor, kept: Tensor) -> Tensor:
    """A process's mean over its elements (), so that the average over processes is that over all elements.

    Otherwise a word or an action would weigh more beside padding. Every process must call it.

    Args:
        mean: (), over the elements that are kept.
        kept: bool, which these are.
    """
    if not _are_several():
        return mean
    num_kept = kept.sum()
    num_in_all = num_kept.clone()
    distributed.all_reduce(num_in_all)
    return mean * num_kept * distributed.get_world_size() / num_in_all.clamp(min=1)


class SavesTiedWeightsOnce(nn.Module):
    """A policy whose checkpoints hold weights that modules share once, as strict loading demands.

    FSDP gathers them once for each module. Stands before LeRobot's `PreTrainedPolicy`.
    """

    def _save_pretrained(self, save_directory: Path, state_dict: dict[str, Tensor] | None = None) -> None:
        if state_dict is not None:
            names = defaultdict(list)
            for name, parameter in self.named_parameters(remove_duplicate=False):
                names[parameter].append(name)
            state_dict = dict(state_dict)
            for first, *others in names.values():
                state_dict.update((other, state_dict[first]) for other in others)
        policy: Any = super()
        policy._save_pretrained(save_directory, state_dict)


def _are_several() -> bool:
    return distributed.is_available() and distributed.is_initialized()
