"""Numbers that are NaN or infinite are an error that says where they are; one definition for all of us."""

from torch import Tensor


def is_finite(values: Tensor) -> bool:
    """Whether no value is NaN or infinite; for a tensor on CUDA the host waits.

    A sum of values that are not finite never is, so the values are looked at one by one, which takes 30
    times as long, only where the sum overflows or something is wrong.
    """
    return bool(_readable(values).sum().isfinite()) or not bool(_bad(values).any())


def require_finite(values: Tensor, name: str, advice: str = "") -> None:
    """Raise a ValueError with count and first index, unless all values are finite."""
    if is_finite(values):
        return
    bad = _bad(values)
    first = f" the first at {bad.nonzero()[0].tolist()}" if bad.ndim else " the only one"
    raise ValueError(
        f"{name} is not finite: {int(bad.sum())} of {bad.numel()} values are NaN or infinite,{first}{advice}"
    )


def _bad(values: Tensor) -> Tensor:
    """Which are NaN or infinite."""
    return ~_readable(values).isfinite()


def _readable(values: Tensor) -> Tensor:
    """Torch computes nothing with 8 bit floats."""
    return values.float() if values.is_floating_point() and values.element_size() == 1 else values
