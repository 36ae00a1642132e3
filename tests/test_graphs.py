"""Graphs that CUDA captures, where there is no CUDA: `tests/outside/check_cuda.py` is for a GPU."""

import copy

import torch
from torch import Tensor, nn

from lerobot_bomb.cuda_graphs import GraphedFunction, GraphedModel


def test_other_devices_call_the_function() -> None:
    calls: list[Tensor] = []

    def double(x: Tensor) -> tuple[Tensor]:
        calls.append(x)
        return (2 * x,)

    captured = GraphedFunction(double)
    assert captured(torch.ones(2))[0].tolist() == [2, 2] and captured(torch.ones(3))[0].tolist() == [2, 2, 2]
    assert len(calls) == 2


class Doubled(nn.Module):
    """A model that has its own function captured, as a policy does."""

    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(2, 2, bias=False)
        self.captured = GraphedModel(self.run, [self.linear])

    def run(self, x: Tensor) -> tuple[Tensor]:
        return (2 * self.linear(x),)


@torch.no_grad()
def test_a_captured_model_has_the_weights_of_now_and_a_copy_its_own() -> None:
    model = Doubled()
    model.linear.weight.copy_(torch.eye(2))
    copied = copy.deepcopy(model)
    model.linear.weight.data = 3 * torch.eye(2)
    x = torch.tensor([1.0, 2.0])
    assert model.captured("any", x)[0].tolist() == [6, 12]
    assert copied.captured("any", x)[0].tolist() == [2, 4]
    assert [name for name, _ in model.named_parameters()] == ["linear.weight"]
