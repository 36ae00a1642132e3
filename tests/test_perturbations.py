"""Conditions as they are written; what they do to an episode is tested in test_axes.py."""

import copy
import json
import pickle
import re
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.perturbations import AXES, NUISANCES, Condition

RANGES = st.tuples(st.integers(0, 5), st.integers(0, 5)).map(sorted)


@pytest.mark.parametrize(
    ("text", "canonical", "key"),
    [
        ("none", "none", "none"),
        ("camera:3", "camera:3", "camera-3"),
        ("light:3+camera:2", "camera:2+light:3", "camera-2.light-3"),
        ("all:1-5", "all:1-5", "all-1to5"),
        ("goal_marker:2+all:5", "all:5+goal_marker:2", "all-5.goal-marker-2"),
        ("camera:0-2", "camera:0-2", "camera-0to2"),
        ("camera:4-4", "camera:4", "camera-4"),
        ("camera:0+light:1", "light:1", "light-1"),
        ("all:0", "none", "none"),
    ],
)
def test_a_condition_has_one_spelling_and_a_key(text: str, canonical: str, key: str) -> None:
    condition = Condition(text)
    assert (str(condition), condition.key) == (canonical, key)
    assert EpisodeSpec(seed=0, perturbations=text).perturbations == canonical


@given(st.dictionaries(st.sampled_from(list(AXES)), RANGES))
def test_conditions_survive_their_spelling_and_keys_are_fit_for_a_suite(ranges: dict[str, list[int]]) -> None:
    text = "+".join(f"{axis}:{low}-{high}" for axis, (low, high) in ranges.items()) or "none"
    condition = Condition(text)
    assert {axis: [low, high] for axis, low, high in condition.ranges} == {
        axis: levels for axis, levels in ranges.items() if levels != [0, 0]
    }
    assert Condition(str(condition)) == condition
    assert re.fullmatch(r"[a-z0-9.-]+", condition.key)


def test_a_spec_carries_its_condition_as_an_object_that_is_its_text() -> None:
    spec = EpisodeSpec(seed=0, perturbations="light:3+camera:1-2")
    for same in (spec, replace(spec, seed=1), copy.deepcopy(spec), pickle.loads(pickle.dumps(spec))):
        assert same.condition.ranges == (("camera", 1, 2), ("light", 3, 3))
        assert same.condition is same.perturbations
    assert '"perturbations": "camera:1-2+light:3"' in json.dumps(spec.to_dict())


def test_all_stands_for_every_nuisance_and_no_help() -> None:
    assert [axis for axis, _, _ in Condition("all:2").ranges] == list(NUISANCES)
    assert "goal_marker" not in NUISANCES


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("each:3", "'each' is several conditions, where one is needed; choose one of: table, reflectance"),
        ("camra:3", "'camra' is not an axis; choose one of: table, reflectance, stones"),
        ("camera:6", "levels of camera must lie in 0..5"),
        ("camera:-1", "levels of camera must lie in 0..5"),
        ("camera:3-1", "must lie in 0..5, lowest first"),
        ("camera", "'camera' is not a perturbation; write 'none', AXIS:LEVEL or AXIS:LOW-HIGH"),
        ("camera:2 + light:3", "'camera:2 ' is not a perturbation"),
        ("camera:2++light:3", "'' is not a perturbation"),
        ("", "'' is not a perturbation"),
        ("camera:2.5", "without spaces, capitals and fractions"),
        ("all:2+camera:3", "names the axis camera twice; all includes it"),
        ("camera:2+camera:3", "names the axis camera twice"),
    ],
)
def test_a_malformed_condition_is_refused(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        EpisodeSpec(seed=0, perturbations=text)
    assert str(error.value).startswith(f"--env.perturbations={text!r}")


def test_magnitudes_grow_with_the_level() -> None:
    for axis in AXES.values():
        for magnitude in axis.magnitudes.values():
            # what dims is a factor below one
            levels = (
                magnitude.levels if magnitude.levels[-1] >= magnitude.levels[0] else magnitude.levels[::-1]
            )
            assert list(levels) == sorted(levels)
        assert any(len(set(m.levels)) == 5 for m in axis.magnitudes.values())
