"""benchmarks/flow_toy.py in a shorter form, and its bars."""

import json
from pathlib import Path

import flow_toy
import imageio.v3 as iio
import pytest
import torch
from flow_toy import BOTH, LEFT, MODES_MD, NEAR, STD, measure
from torch import Tensor

VARIANT = "both heads"


@pytest.mark.long
def test_a_short_training_hears_words_through_dualmod_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    figures_path, plot_path = tmp_path / "toy.json", tmp_path / "toy.png"
    flags = f"flow_toy.py --steps=150 --samples=200 --json={figures_path} --plot={plot_path}"
    monkeypatch.setattr("sys.argv", flags.split())
    monkeypatch.setattr(flow_toy, "SAMPLING_STEPS", 20)
    with pytest.raises(SystemExit, match="1"):  # so little training misses bars
        flow_toy.main()
    rows = json.loads(figures_path.read_text())["rows"]
    shares = {(row["variant"], row["word"]): row["shares"] for row in rows}
    for name, variant in flow_toy.VARIANTS.items():
        left, right = shares[name, "left"], shares[name, "right"]
        if variant.use_dualmod:
            assert left[0] > 0.8 and right[1] > 0.8
        else:
            assert left == right
        assert 0.3 < shares[name, "any"][0] < 0.7
    assert iio.imread(plot_path).std() > 10


@pytest.mark.parametrize(
    ("flag", "message"),
    [
        ("--samples=10", "--samples=10 is too few to measure clouds; at least 100"),
        ("--plot=toy.txt", "'toy.txt' must end in .png or .jpg"),
        ("--plot=absent/toy.png", "'absent/toy.png' cannot be written"),
        ("--json=absent/toy.json", "'absent/toy.json' cannot be written"),
    ],
)
def test_flags_are_checked_before_training(
    flag: str, message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["flow_toy.py", flag])
    with pytest.raises(SystemExit, match="2"):
        flow_toy.main()
    assert message in capsys.readouterr().err


@pytest.fixture
def cloud() -> Tensor:
    """(1000, 2) around the left mode."""
    return MODES_MD[0] + STD * torch.randn(1000, 2, generator=torch.Generator().manual_seed(0))


def test_the_data_meet_the_bars(cloud: Tensor) -> None:
    row = measure(VARIANT, "left", LEFT, cloud)
    assert row.passes and row.shares == pytest.approx([1, 0], abs=0.002)
    mirrored = cloud * torch.tensor([-1.0, 1.0])
    assert measure(VARIANT, "any", BOTH, torch.cat([cloud, mirrored])).passes


@pytest.mark.parametrize("change", ["other mode", "moved", "narrow", "one mode of two", "strays", "nothing"])
def test_what_misses_a_bar(cloud: Tensor, change: str) -> None:
    changed = {
        "other mode": cloud * torch.tensor([-1.0, 1.0]),
        "moved": cloud + torch.tensor([0.0, 0.15]),
        "narrow": MODES_MD[0] + 0.8 * (cloud - MODES_MD[0]),
        "one mode of two": cloud,
        "strays": torch.cat([cloud, torch.zeros(20, 2)]),
        "nothing": torch.full((10, 2), 10 * NEAR),
    }
    meant = BOTH if change == "one mode of two" else LEFT
    assert not measure(VARIANT, "a word", meant, changed[change]).passes
