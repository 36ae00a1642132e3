"""benchmarks/flow_samplers.py: its exact heads, and what it prints."""

import json
import sys
from pathlib import Path

import flow_samplers
import pytest
import torch
from flow_cases import gaussian_heads
from flow_samplers import mixture_heads, of_one_mode, of_two_modes


def test_a_mixture_of_one_or_of_far_modes_is_gaussian() -> None:
    actions, tau = torch.tensor([0.3, 1.7]).view(2, 1, 1), torch.tensor([0.4, 0.9])
    expected = gaussian_heads(1.0, 0.5)(actions, tau)
    for means in ([1.0], [1.0, -30.0]):
        for found, of_gaussian in zip(
            mixture_heads(torch.tensor(means), 0.5)(actions, tau), expected, strict=True
        ):
            torch.testing.assert_close(found, of_gaussian)


def test_between_the_modes_of_a_mixture_the_clean_action_is_their_mean() -> None:
    velocity, noise = mixture_heads(torch.tensor([-1.0, 1.0]), 0.1)(torch.zeros(1, 1, 1), torch.tensor([0.5]))
    assert velocity is not None and noise is not None
    assert (velocity + noise).item() == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(
    ("sampler", "num_steps", "mean", "std"),
    [("residual", 10, 1, 0.430783), ("ddim", 10, 0.991180, 0.440990), ("sde", 1, 1, 0.830662)],
)
def test_one_mode(sampler: str, num_steps: int, mean: float, std: float) -> None:
    assert of_one_mode({"sampler": sampler}, num_steps) == pytest.approx((mean, std), abs=2e-5)


def test_two_modes() -> None:
    assert of_two_modes({"sampler": "residual"}, 100) == pytest.approx((0.5, 0.997, 0.0975), abs=1e-3)


def test_tables_and_figures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "samplers.json"
    monkeypatch.setattr(sys, "argv", ["flow_samplers.py", f"--json={path}"])
    monkeypatch.setattr(flow_samplers, "NUM_STEPS", (1, 5))
    flow_samplers.main()
    rows = [line.split() for line in capsys.readouterr().out.splitlines() if line.startswith("flow")]
    assert rows == [
        ["flow", "1.000", "0.000", "1.000", "0.369"],
        ["flow", "0.0%", "0.000", "0.000", "50.0%", "0.956", "0.120"],
    ]
    assert json.loads(path.read_text())["one_mode"]["flow"][1] == pytest.approx([1, 0.369231], abs=1e-5)
