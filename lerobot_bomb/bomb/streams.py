"""Streams of random numbers: one generator for each quantity that a seed draws.

Drawing one quantity differently (a perturbation, an explicit target) then leaves all others as they were.
The numbers are part of the protocol: append only.
"""

from enum import IntEnum

import numpy as np


class Stream(IntEnum):
    """Stream of random numbers, one for each quantity that an episode draws."""

    TARGET = 0
    COLOR = 1
    TEMPLATE = 2
    OPENING = 3
    GRIPPER = 4
    START = 5
    SUPPLY = 6
    LEVEL = 100  # plus the axis' place in AXES: the level, where the condition gives a range
    STATIC = 7  # what a static scene draws beside its episode's start
    POINTING = 8  # other places, beside the expert's
    AXIS = 200  # plus the axis' place in AXES: everything else that the axis draws
    ACTUATOR_NOISE = 300


RECORDER_NOISE = 0xDA57  # stands before the seed


def generator(seed: int, stream: int) -> np.random.Generator:
    """Return the generator of one stream of an episode's seed."""
    return np.random.default_rng([seed, stream])


def recorder_noise(seed: int) -> np.random.Generator:
    """Return the generator of the noise on the actions of a recorded episode."""
    return np.random.default_rng([RECORDER_NOISE, seed])
