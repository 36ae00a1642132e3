import pytest
import torch

from lerobot_bomb.flow.path import draw_tau, path_point

CLEAN, NOISE = torch.tensor([[[1.0, -0.5]]]), torch.tensor([[[0.2, 0.4]]])


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_a_quarter_of_the_way() -> None:
    point = path_point(CLEAN, NOISE, torch.tensor([0.25]))
    torch.testing.assert_close(point.actions, torch.tensor([[[0.4, 0.175]]]))
    torch.testing.assert_close(point.velocity, torch.tensor([[[0.8, -0.9]]]))
    torch.testing.assert_close(point.noise, NOISE)
    assert point.tau.tolist() == [0.25]


def test_every_row_has_a_tau_of_its_own_from_noise_to_clean_actions() -> None:
    point = path_point(CLEAN.expand(3, 4, 2), NOISE.expand(3, 4, 2), torch.tensor([0.0, 0.5, 1.0]))
    assert point.actions[0].equal(NOISE.expand(3, 4, 2)[0])
    torch.testing.assert_close(point.actions[1], torch.tensor([0.6, -0.05]).expand(4, 2))
    assert point.actions[2].equal(CLEAN.expand(3, 4, 2)[2])


def test_targets_follow_from_where_the_path_is() -> None:
    clean, noise = torch.randn(2, 50, 3, 2, generator=seeded())
    tau = torch.rand(50, generator=seeded()) * 0.9
    point = path_point(clean, noise, tau)
    torch.testing.assert_close(point.velocity, (clean - point.actions) / (1 - tau[:, None, None]))
    torch.testing.assert_close(point.noise, point.actions - tau[:, None, None] * point.velocity)


# share of draws up to 0, 1/4, 1/2, 3/4 and 1
@pytest.mark.parametrize(
    ("time_sampling", "shares"),
    [
        ("uniform", [0, 0.25, 0.5, 0.75, 1]),
        ("beta", [0, 0.3508, 0.6470, 0.8754, 1]),  # 1 - (1 - tau / 0.999)^1.5
    ],
)
def test_distribution_of_tau(time_sampling: str, shares: list[float]) -> None:
    tau = draw_tau(time_sampling, 200_000, seeded())
    assert tau.shape == (200_000,) and tau.dtype == torch.float32
    found = [(tau < limit).float().mean().item() for limit in (0, 0.25, 0.5, 0.75, 1)]
    assert found == pytest.approx(shares, abs=0.004)


def test_beta_ends_before_the_clean_actions() -> None:
    assert 0.998 < draw_tau("beta", 200_000, seeded()).max() <= 0.999


@pytest.mark.parametrize("time_sampling", ["uniform", "beta"])
def test_tau_follows_from_the_seed(time_sampling: str) -> None:
    first, again, other = (draw_tau(time_sampling, 8, seeded(seed)) for seed in (1, 1, 2))
    assert first.equal(again) and not first.equal(other)


def test_unknown_time_sampling() -> None:
    with pytest.raises(ValueError, match="time_sampling='gaussian' is unknown; choose one of: uniform, beta"):
        draw_tau("gaussian", 2, seeded())
