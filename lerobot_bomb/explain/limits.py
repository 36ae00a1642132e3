"""Limits below which an effect counts as none; of the names in a sentence; a name of effects."""

ALL = "all cameras"  # an object's effect where it is taken out of all images at once
# a drop of the score that is no larger than this share of it, or this in its unit, may be rounding
SMALLEST_DROP = 1e-4
SHARE = 0.05  # an effect below this share of the largest of its kind is none
SMALLEST_MM = 1.0  # a change of the next action that is less than this far is none
MAX_NAMES = 4  # that a sentence lists
RESTORES = 0.5  # share of the drop that a head alone must restore to be named


def smallest_drop(clean_score: float) -> float:
    """Return the smallest drop of the score that is more than rounding."""
    return SMALLEST_DROP * max(1.0, abs(clean_score))
