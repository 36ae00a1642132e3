"""Inputs that the networks of any policy receive."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from lerobot.policies import PreTrainedPolicy
from torch import Tensor, nn
from transformers import PreTrainedModel
from transformers.modeling_layers import GradientCheckpointingLayer

type Batch = dict[str, Any]
# tensors in the order of the calls, by kind, module and argument
type Inputs = dict[str, list[Tensor]]


def kind_of_entry(module: nn.Module) -> str | None:
    """Return how a module takes in data: pixels, ids, or ("model") embeddings and masks."""
    if isinstance(module, nn.Conv2d | nn.Conv3d) and module.in_channels == 3:
        return "pixels"
    if isinstance(module, nn.Embedding):
        return "ids"
    return "model" if isinstance(module, PreTrainedModel | GradientCheckpointingLayer) else None


@contextmanager
def probes(policy: PreTrainedPolicy) -> Iterator[Inputs]:
    """Collect every tensor that enters the networks meanwhile."""
    seen: Inputs = {}

    def note(name: str) -> Callable[[nn.Module, tuple, dict], None]:
        def hook(_: nn.Module, args: tuple, kwargs: dict) -> None:
            for key, value in [*enumerate(args), *kwargs.items()]:
                if isinstance(value, Tensor):
                    seen.setdefault(f"{name}({key})", []).append(value.detach().clone())

        return hook

    handles = [
        module.register_forward_pre_hook(note(f"{kind} {name}"), with_kwargs=True)
        for name, module in policy.named_modules()
        if (kind := kind_of_entry(module))
    ]
    try:
        yield seen
    finally:
        for handle in handles:
            handle.remove()


@torch.no_grad()
def inference_inputs(policy: PreTrainedPolicy, batch: Batch) -> Inputs:
    """Return what the networks receive on the way to the next action, and that action."""
    policy.eval()
    with pytest.MonkeyPatch.context() as patch, probes(policy) as seen:
        patch.setattr(policy.config, "n_action_steps", 1)  # a prediction no longer than necessary
        policy.reset()
        seen["action"] = [policy.select_action(batch)]
    policy.reset()
    assert {"pixels", "ids", "model"} <= {name.split()[0] for name in seen}
    return seen


def first_ids(seen: Inputs) -> dict[str, Tensor]:
    """Return what every embedding looks up in its first call, if that is rows of prompts and no choice."""
    return {name: calls[0] for name, calls in seen.items() if name.startswith("ids") and calls[0].ndim == 2}


def pixels(policy: PreTrainedPolicy, seen: Inputs, batch_size: int) -> Tensor:
    """(images, values) as the networks get them: a row per image of the batch, whatever their layout."""
    calls = [tensor for name, calls in seen.items() if name.startswith("pixels") for tensor in calls]
    return torch.cat(calls).reshape(batch_size * len(policy.config.image_features), -1)


def repeated(batch: Batch, times: int) -> Batch:
    """A batch of one row, so many times."""
    return joined([batch] * times)


def joined(batches: list[Batch]) -> Batch:
    """Batches of equally many tokens as one."""

    def join(values: list[Any]) -> Any:
        if isinstance(values[0], Tensor):
            return torch.cat(values)
        return [item for value in values for item in value] if isinstance(values[0], list) else values[0]

    return {key: join([batch[key] for batch in batches]) for key in batches[0]}
