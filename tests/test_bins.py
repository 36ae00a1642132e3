import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lerobot_bomb.actions.bins import Bins

VALUES = torch.tensor([-1.1, -1.0, -0.5, 0.0, 0.1234, 0.5, 1.0, 1.5])


def test_centers_of_512_bins() -> None:
    bins = Bins(512, "centers")
    assert bins.encode(VALUES).tolist() == [0, 0, 128, 255, 287, 383, 511, 511]
    assert bins.decode(torch.tensor([287])).item() == pytest.approx(0.123047, abs=1e-6)
    assert bins.decode(torch.tensor([0])).item() == pytest.approx(-1 + 1 / 512, abs=1e-7)


def test_centers_of_1000_bins() -> None:
    bins = Bins(1000, "centers")
    assert bins.encode(torch.tensor([-1.0, -0.5, 0.1234, 0.5, 1.0])).tolist() == [0, 250, 561, 749, 999]
    assert bins.decode(torch.tensor(561)).item() == pytest.approx(0.123, abs=1e-6)


def test_999_levels() -> None:
    bins = Bins(999, "levels")
    assert bins.encode(VALUES).tolist() == [0, 0, 250, 499, 561, 749, 998, 998]
    assert bins.decode(torch.tensor([0, 499, 998])).tolist() == [-1.0, 0.0, 1.0]
    assert bins.decode(torch.tensor(561)).item() == pytest.approx(0.1242485, abs=1e-6)


def test_1001_levels() -> None:
    bins = Bins(1001, "levels")
    assert bins.encode(torch.tensor(0.1234)).item() == 562
    assert bins.decode(torch.tensor(562)).item() == pytest.approx(0.124, abs=1e-6)


def test_intervals_are_closed_on_the_right() -> None:
    bins = Bins(4, "centers")
    edge = bins.edges[2]
    above = torch.nextafter(edge, torch.tensor(1.0))
    assert bins.encode(torch.stack([edge, above])).tolist() == [1, 2]


@given(
    values=st.lists(st.floats(-3, 3, width=32), min_size=1, max_size=50),
    num_bins=st.integers(2, 2000),
    mode=st.sampled_from(["centers", "levels"]),
)
def test_round_trip_error_is_at_most_half_a_bin(values: list[float], num_bins: int, mode: str) -> None:
    bins = Bins(num_bins, mode)
    clipped = torch.tensor(values).clamp(-1, 1)
    indices = bins.encode(torch.tensor(values))
    assert indices.min() >= 0
    assert indices.max() < num_bins
    bound = 1 / num_bins if mode == "centers" else 1 / (num_bins - 1)
    assert (bins.decode(indices) - clipped).abs().max() <= bound + 3e-6


@given(num_bins=st.integers(2, 3000), mode=st.sampled_from(["centers", "levels"]))
def test_decoded_indices_encode_to_themselves(num_bins: int, mode: str) -> None:
    indices = torch.arange(num_bins)
    bins = Bins(num_bins, mode)
    assert torch.equal(bins.encode(bins.decode(indices)), indices)
