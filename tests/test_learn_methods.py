"""The table of methods.py: rates of several trainings, and differences over the same episodes."""

import methods
import pytest
from recipes import read_recipe
from result_rows import read, values

from lerobot_bomb.results.bomb import EpisodeResult


def run(suite: str, *solved: bool) -> list[EpisodeResult]:
    """Return the episodes of a training, from seed 0 on."""
    return [
        read(
            values(
                seed, None if is_solved else "imprecise", None if is_solved else 15.0, spec={"suite": suite}
            )
        )
        for seed, is_solved in enumerate(solved)
    ]


def test_an_episode_counts_by_the_trainings_that_solved_it() -> None:
    runs = [run("place", True, True, False), run("place", True, False, False) + run("spatial", True)]
    assert methods.episode_means(runs, "place") == {0: 1.0, 1: 0.5, 2: 0.0}
    assert methods.episode_means(runs, "spatial") == {0: 1.0}


def test_the_table_has_rates_and_paired_differences(capsys: pytest.CaptureFixture[str]) -> None:
    both = [
        [run(suite, *solved) for suite in methods.SUITES]
        for solved in ([False] * 5 + [True] * 5, [False] * 2 + [True] * 8)
    ]
    off, on = ([place + spatial] for place, spatial in both)
    methods.print_parts(["masking"], {"vla0_unmasked": off, "vla0_smol": on})
    first, second = capsys.readouterr().out.splitlines()[-2:]
    assert first.split() == ["masking", "off", "50.0", "%", "50", "-", "50.0", "%", "50", "-"]
    # of ten drawn episodes with replacement, three of which differ
    assert second.split() == [
        *("masking", "on", "80.0", "%", "80", "+30.0", "[+0.0,", "+60.0]"),
        *("80.0", "%", "80", "+30.0", "[+0.0,", "+60.0]"),
    ]


def test_every_version_differs_from_the_first_in_the_part_that_is_named() -> None:
    for part, settings in methods.PARTS.items():
        versions = [methods.VERSIONS[name] for name in settings.values()]
        assert len(set(versions)) == len(versions) > 1, part
        assert len({version.policy_type for version in versions}) == 1, part
        read_recipe(methods.RECIPE, versions[0].policy_type)
