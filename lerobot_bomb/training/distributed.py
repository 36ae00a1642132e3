"""Processes that train one policy, each on batches of its own; their gradients are averaged."""

from collections import defaultdict
from pathlib import Path
from typing import Any, cast

from huggingface_hub import save_torch_state_dict
from torch import Tensor, distributed, nn
from torch.distributed.checkpoint.state_dict import StateDictOptions, get_model_state_dict
from torch.distributed.fsdp import FSDPModule

ONE_FILE = "1000TB"  # no checkpoint is larger


def process_number() -> int:
    """Return the number of this process, from 0; 0 if there is only one."""
    return distributed.get_rank() if _are_several() else 0


def weighed(mean: Tensor, kept: Tensor) -> Tensor:
    """Weigh a process's mean, (), so that the average over processes is the mean over all elements.

    Otherwise a word or an action beside padding would weigh more. Every process must call this.

    Args:
        mean: (), over the elements that are kept.
        kept: bool, mask of these elements.
    """
    if not _are_several():
        return mean
    num_kept = kept.sum()
    num_in_all = num_kept.clone()
    distributed.all_reduce(num_in_all)
    return mean * num_kept * distributed.get_world_size() / num_in_all.clamp(min=1)


class SavesTiedWeightsOnce(nn.Module):
    """Mixin that saves weights shared by modules once, as strict loading demands.

    FSDP gathers them once for each module. It stands before LeRobot's `PreTrainedPolicy` among the bases.
    """

    config: Any

    def _save_pretrained(self, save_directory: Path, state_dict: dict[str, Tensor] | None = None) -> None:
        """Save a policy: LeRobot 0.6.1 gives a gathered state; from 0.6.2 on all processes call this."""
        if state_dict is None and isinstance(self, FSDPModule):
            whole = StateDictOptions(full_state_dict=True, cpu_offload=True)
            state_dict = cast("dict[str, Tensor]", get_model_state_dict(self, options=whole))
        if state_dict is None:
            policy: Any = super()
            policy._save_pretrained(save_directory)
        elif state_dict:  # only the first process has it
            self.config._save_pretrained(save_directory)
            save_torch_state_dict(self._tied(state_dict), save_directory, max_shard_size=ONE_FILE)

    def _tied(self, state_dict: dict[str, Tensor]) -> dict[str, Tensor]:
        names = defaultdict(list)
        for name, parameter in self.named_parameters(remove_duplicate=False):
            names[parameter].append(name)
        return state_dict | {
            other: state_dict[first] for first, *others in names.values() for other in others
        }


def _are_several() -> bool:
    return distributed.is_available() and distributed.is_initialized()
