from typing import Any

import pytest
from pusht_report import Seed, over_episodes, over_seeds, print_report


def column(policy: float, repeat: float) -> dict[str, Any]:
    def l1(mean: float) -> dict[str, Any]:
        return {"all": {"mean": mean}, "steps": [{"mean": mean - 1}, {"mean": mean + 1}]}

    return {"l1": {"policy": l1(policy), "repeat": l1(repeat), "mean": l1(80)}}


def seeds(*policy_l1: float) -> list[Seed]:
    return [Seed(column(l1, 30.0), 10.0, 15.0, [0.25, 0.75]) for l1 in policy_l1]


def test_mean_and_t_interval_of_three_seeds() -> None:
    # standard deviation 1, so the half width is 4.303 / sqrt(3)
    assert over_seeds([9.0, 10.0, 11.0]) == "10.0 [7.5, 12.5]"
    assert over_seeds([0.5]) == "0.500"


def test_mean_over_episodes() -> None:
    assert over_episodes([0.25, 0.75]) == "0.500 [0.250, 0.750] over 2 episodes"
    assert over_episodes([0.5]) == "0.500 over 1 episodes"


@pytest.mark.parametrize(("worst", "beaten"), [(29.9, True), (30.0, False)])
def test_every_seed_of_the_recipe_must_beat_every_predictor(
    worst: float, beaten: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    variants = {"recipe": seeds(25.0, worst), "absolute": seeds(50.0, 50.0)}
    assert print_report(variants, "recipe") is beaten
    text = capsys.readouterr().out
    assert ("NOT beaten by every seed" in text) is not beaten
    assert "best trivial predictor: repeat with 30.0 px" in text
    absolute, _ = (line.split() for line in text.splitlines() if line.startswith("absolute"))
    assert absolute[1:4] == ["50.0", "[50.0,", "50.0]"]
    assert absolute[-2:] == ["10.0", "15.0"]
    (steps,) = (line for line in text.splitlines() if line.split()[:2] == ["repeat", "30.0"])
    assert steps.split() == ["repeat", "30.0", "29.0", "31.0"]
    assert "seed 0: mean maximal coverage 0.500 [0.250, 0.750] over 2 episodes" in text
