"""Probes of a layer's states by a linear map: where is the destination known?

A probe is a ridge regression. It is judged on held-out episodes, beside probes of shuffled labels: their
score is what so many features find in nothing.

Shapes: `N` episodes, `F` features, `C` classes or coordinates.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

MIN_EPISODES = 10
HELD_OUT = 0.3  # share of the episodes
NUM_SHUFFLES = 20
PENALTY = 1.0  # times the number of episodes that are fitted, on features of unit variance


@dataclass(frozen=True)
class Probe:
    """Score of a probe, which reads labels off states, on held-out episodes."""

    score: float  # share of right classes, or the share of variance that is explained (R squared)
    floor: float  # the same with shuffled labels, mean of NUM_SHUFFLES
    num_held_out: int
    num_right: int | None  # of classes


def probe_classes(features_NF: np.ndarray, labels_N: np.ndarray, seed: int = 0) -> Probe:
    """Probe whether a number is known, such as the target's row.

    Raises:
        ValueError: there are fewer than MIN_EPISODES.
    """
    classes = np.unique(labels_N)
    one_hot_NC = (labels_N[:, None] == classes).astype(np.float64)

    def num_right(targets_NC: np.ndarray, train: np.ndarray, test: np.ndarray) -> int:
        predicted = _predict(features_NF, targets_NC, train, test)
        return int((predicted.argmax(axis=1) == targets_NC[test].argmax(axis=1)).sum())

    train, test = _split(len(labels_N), seed)
    right = num_right(one_hot_NC, train, test)
    rng = np.random.default_rng(seed)
    shuffled = [num_right(rng.permutation(one_hot_NC), train, test) for _ in range(NUM_SHUFFLES)]
    return Probe(right / len(test), float(np.mean(shuffled)) / len(test), len(test), right)


def probe_values(features_NF: np.ndarray, values_NC: np.ndarray, seed: int = 0) -> Probe:
    """Probe whether a place is known, such as the stone's; raises as `probe_classes`."""

    def explained(targets_NC: np.ndarray, train: np.ndarray, test: np.ndarray) -> float:
        errors = _predict(features_NF, targets_NC, train, test) - targets_NC[test]
        spread = targets_NC[test] - targets_NC[train].mean(axis=0)
        return 1 - float((errors**2).sum() / (spread**2).sum())

    train, test = _split(len(values_NC), seed)
    score = explained(values_NC, train, test)
    rng = np.random.default_rng(seed)
    shuffled = [explained(rng.permutation(values_NC), train, test) for _ in range(NUM_SHUFFLES)]
    return Probe(score, float(np.mean(shuffled)), len(test), None)


@dataclass(frozen=True)
class LayerProbe:
    """A probe of one layer's states."""

    what: str  # label that is read
    place: str  # span of the tokens
    layer: int
    probe: Probe


def probe_layers(
    states: Mapping[str, np.ndarray], classes: Mapping[str, np.ndarray], values: Mapping[str, np.ndarray]
) -> list[LayerProbe]:
    """Probe every label by the states of every layer.

    Args:
        states: {place: (N, layers, F)}.
        classes: {what: (N,) whole numbers}.
        values: {what: (N, C)}.
    """
    found = []
    for place, states_NLF in states.items():
        for layer in range(states_NLF.shape[1]):
            features_NF = states_NLF[:, layer]
            probes = {what: probe_classes(features_NF, labels) for what, labels in classes.items()}
            probes |= {what: probe_values(features_NF, targets) for what, targets in values.items()}
            found += [LayerProbe(what, place, layer, probe) for what, probe in probes.items()]
    return sorted(found, key=lambda each: each.what)


def _split(num_episodes: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    if num_episodes < MIN_EPISODES:
        raise ValueError(
            f"{num_episodes} episodes are too few for a probe; give at least --episodes={MIN_EPISODES}"
        )
    order = np.random.default_rng(seed).permutation(num_episodes)
    num_test = round(HELD_OUT * num_episodes)
    return order[num_test:], order[:num_test]


def _predict(
    features_NF: np.ndarray, targets_NC: np.ndarray, train: np.ndarray, test: np.ndarray
) -> np.ndarray:
    """Predict targets of episodes ``test`` by a ridge regression on ``train``, solved in its dual form."""
    mean_F, std_F = features_NF[train].mean(axis=0), features_NF[train].std(axis=0)
    scaled_NF = (features_NF - mean_F) / np.where(std_F > 0, std_F, 1) / np.sqrt(features_NF.shape[1])
    known_NF, mean_C = scaled_NF[train], targets_NC[train].mean(axis=0)
    kernel = known_NF @ known_NF.T + PENALTY * len(train) / features_NF.shape[1] * np.eye(len(train))
    return scaled_NF[test] @ known_NF.T @ np.linalg.solve(kernel, targets_NC[train] - mean_C) + mean_C
