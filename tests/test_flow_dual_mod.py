import pytest
import torch
from torch import Tensor, nn

from lerobot_bomb.flow.dual_mod import FiLM, masked_mean_pool


def rows(batch_size: int, size: int, seed: int = 0) -> Tensor:
    return torch.randn(batch_size, size, generator=torch.Generator().manual_seed(seed))


def trained_film() -> FiLM:
    """One whose scales and shifts depend on the pooled states."""
    film = FiLM(state_size=8, dualmod_dim=6, head_dim=3)
    nn.init.normal_(film.layers[-1].get_parameter("weight"), generator=torch.Generator().manual_seed(0))
    return film


def test_scale_and_shift() -> None:
    film = FiLM(state_size=4, dualmod_dim=5, head_dim=3)
    film.layers[-1].bias.data = torch.tensor([1.5, 0.5, 1, 0.1, 0, -0.25])
    modulated = film(torch.tensor([[[1, -2, 0.5], [0, 0, 0]]]), rows(1, 4))
    torch.testing.assert_close(modulated, torch.tensor([[[1.6, -1, 0.25], [0.1, 0, -0.25]]]))


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_exactly_the_identity_before_training(dtype: torch.dtype) -> None:
    film = FiLM(state_size=8, dualmod_dim=6, head_dim=3).to(dtype)
    features = 100 * rows(2, 12).view(2, 4, 3).to(dtype)
    assert film(features, 100 * rows(2, 8).to(dtype)).equal(features)


def test_every_parameter_learns() -> None:
    film = FiLM(state_size=8, dualmod_dim=6, head_dim=3)
    features = rows(2, 12).view(2, 4, 3).requires_grad_()
    pooled = rows(2, 8).requires_grad_()
    film(features, pooled).square().sum().backward()
    assert features.grad is not None and features.grad.all()
    for parameter in film.layers[-1].parameters():
        assert parameter.grad is not None and parameter.grad.any()
        parameter.data -= 0.1 * parameter.grad
    film(features, pooled).square().sum().backward()  # now that the last layer passes something back
    assert pooled.grad is not None and pooled.grad.all()
    for name, parameter in film.named_parameters():
        assert parameter.grad is not None and parameter.grad.any(), name


def test_the_same_for_all_action_steps_and_other_for_each_row() -> None:
    film, pooled = trained_film(), rows(2, 8)
    modulated = film(torch.ones(2, 5, 3), pooled)
    assert modulated.equal(modulated[:, :1].expand(2, 5, 3))
    assert (modulated[0, 0] - modulated[1, 0]).abs().min() > 0.01
    torch.testing.assert_close(film(torch.ones(2, 5, 3), pooled.flip(0)), modulated.flip(0))


def test_pooled_states_are_normalised() -> None:
    film, pooled = trained_film(), rows(2, 8)
    features = torch.ones(2, 5, 3)
    torch.testing.assert_close(film(features, 50 * pooled + 7), film(features, pooled), rtol=0, atol=1e-3)


def test_layers_are_as_wide_as_asked() -> None:
    film = FiLM(state_size=8, dualmod_dim=6, head_dim=3)
    assert sum(parameter.numel() for parameter in film.parameters()) == 2 * 8 + (8 * 6 + 6) + (6 * 6 + 6)
    assert isinstance(film.layers[2], nn.SiLU)


def test_mean_of_the_kept_states() -> None:
    states = torch.tensor([[[1.0, 2], [3, 6], [50, 60]], [[4.0, 5], [70, 80], [6, 9]]])
    kept = torch.tensor([[True, True, False], [True, False, True]])
    assert masked_mean_pool(states, kept).tolist() == [[2, 4], [5, 7]]


def test_no_kept_state_is_zeros() -> None:
    states = torch.ones(2, 3, 4)
    pooled = masked_mean_pool(states, torch.tensor([[False] * 3, [True] * 3]))
    assert pooled.tolist() == [[0] * 4, [1] * 4]
    assert trained_film()(torch.ones(1, 5, 3), torch.zeros(1, 8)).isfinite().all()
