import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_bomb.bomb.board import BOARD, COLORS, TRAY_CENTER_XY, TRAY_HALF_SIZE_XY
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.go import is_legal_move, is_legal_position
from lerobot_bomb.bomb.suite import templates_of
from lerobot_bomb.bomb.suites.place import (
    HELDOUT_TARGETS,
    STONE,
    TEMPLATES,
    targets_of,
)
from lerobot_env_bomb.bomb.perturb import PerturbedEpisode as Episode
from lerobot_env_bomb.bomb.perturb import sample_episode
from lerobot_env_bomb.bomb.scene import WORKSPACE_HIGH, WORKSPACE_LOW

SEEDS = st.integers(0, 2**31)
CORNER_CAPTURE = {(0, 1): "white", (1, 0): "white"}  # black in the corner would have no liberty


def opening(episode: Episode) -> dict[tuple[int, int], str]:
    layout = episode.layout
    stones = [i for i in np.flatnonzero(layout.stone_in_play) if i != STONE]
    return {
        BOARD.nearest_intersection(layout.stone_xy[i]): "white" if layout.stone_is_white[i] else "black"
        for i in stones
    }


def test_a_group_without_liberty_is_illegal() -> None:
    assert is_legal_position(CORNER_CAPTURE)
    assert not is_legal_position({**CORNER_CAPTURE, (0, 0): "black"})
    assert not is_legal_position(
        {(0, 0): "black", (0, 1): "black", (1, 0): "white", (1, 1): "white", (0, 2): "white"}
    )


def test_suicide_is_illegal_capture_is_legal_and_a_taken_intersection_is_illegal() -> None:
    assert not is_legal_move(CORNER_CAPTURE, (0, 0), "black")
    assert is_legal_move(CORNER_CAPTURE, (0, 0), "white")
    assert not is_legal_move(CORNER_CAPTURE, (0, 1), "black")
    # black fills its own last liberty, but the white stone at (0, 1) loses its last one too
    surrounded = {(0, 1): "white", (1, 0): "white", (0, 2): "black", (1, 1): "black"}
    assert is_legal_move(surrounded, (0, 0), "black")


@settings(max_examples=300, deadline=None)
@given(SEEDS)
def test_the_target_is_always_free_and_legal(seed: int) -> None:
    episode = sample_episode(EpisodeSpec(seed=seed))
    stones = opening(episode)
    assert is_legal_position(stones)
    assert episode.allows(stones)


@settings(max_examples=300, deadline=None)
@given(SEEDS)
def test_no_two_stones_overlap_and_the_one_to_be_moved_is_under_the_gripper(seed: int) -> None:
    layout = sample_episode(EpisodeSpec(seed=seed)).layout
    xy = layout.stone_xy[layout.stone_in_play]
    distances = np.linalg.norm(xy[:, None] - xy[None], axis=-1)[np.triu_indices(len(xy), k=1)]
    assert (distances > 2 * BOARD.stone_radius_m).all()
    assert np.linalg.norm(layout.stone_xy[STONE] - layout.gripper_xyz[:2]) <= 0.015
    # wholly on the tray, hence off the board and the target
    to_edge = np.array(TRAY_HALF_SIZE_XY) - abs(layout.stone_xy[STONE] - np.array(TRAY_CENTER_XY))
    assert (to_edge >= BOARD.stone_radius_m).all()
    assert layout.stone_xy[STONE, 0] - BOARD.stone_radius_m > BOARD.half_size_m
    assert (layout.gripper_xyz >= WORKSPACE_LOW).all() and (layout.gripper_xyz <= WORKSPACE_HIGH).all()


def test_openings_have_0_to_8_stones_and_all_targets_and_colours_occur() -> None:
    episodes = [sample_episode(EpisodeSpec(seed=seed)) for seed in range(400)]
    assert {len(opening(e)) for e in episodes} == set(range(9))
    assert {e.target for e in episodes} == set(targets_of("all"))
    assert {e.color for e in episodes} == set(COLORS)


def test_the_same_spec_gives_the_same_episode() -> None:
    first, second = (sample_episode(EpisodeSpec(seed=7)) for _ in range(2))
    assert first.instruction == second.instruction
    np.testing.assert_array_equal(first.layout.stone_xy, second.layout.stone_xy)
    np.testing.assert_array_equal(first.layout.gripper_xyz, second.layout.gripper_xyz)


def test_naming_target_and_colour_leaves_the_other_draws_as_they_were() -> None:
    drawn = sample_episode(EpisodeSpec(seed=7))
    named = sample_episode(EpisodeSpec(seed=7, target=(3, 1), color="white"))
    assert (named.target, named.color) == ((3, 1), "white")
    assert named.target != drawn.target
    np.testing.assert_array_equal(named.layout.gripper_xyz, drawn.layout.gripper_xyz)
    np.testing.assert_array_equal(named.layout.stone_xy[STONE], drawn.layout.stone_xy[STONE])


@settings(max_examples=50, deadline=None)
@given(SEEDS, st.sampled_from(targets_of("all")), st.sampled_from(targets_of("all")))
def test_the_board_tells_only_that_the_target_is_free_and_legal(
    seed: int, one: tuple[int, int], other: tuple[int, int]
) -> None:
    for_one, for_other = (
        opening(sample_episode(EpisodeSpec(seed=seed, color="white", target=target)))
        for target in (one, other)
    )
    if is_legal_move(for_one, other, "white") and is_legal_move(for_other, one, "white"):
        assert for_one == for_other


def test_the_instruction_names_colour_row_and_column() -> None:
    episode = sample_episode(EpisodeSpec(seed=0, target=(3, 4), color="black"))
    instructions = {t.format(color="black", row=3, column=4) for t in TEMPLATES}
    assert "Place a black stone on the Go board at row 3, column 4." in instructions
    assert episode.instruction in instructions


def test_the_target_is_where_its_row_and_column_say() -> None:
    corner = sample_episode(EpisodeSpec(seed=0, target=(0, 4))).aims[0].xy
    np.testing.assert_allclose(corner, [0.09, 0.09], atol=1e-12)


def test_splits_share_no_intersection_and_no_instruction() -> None:
    assert len(targets_of("train")) == 20 and len(HELDOUT_TARGETS) == 5
    assert set(targets_of("train")) | set(HELDOUT_TARGETS) == set(targets_of("all"))
    # training still shows every row and every column
    assert sorted(row for row, _ in HELDOUT_TARGETS) == sorted(column for _, column in HELDOUT_TARGETS)
    train, heldout = (templates_of(split, TEMPLATES) for split in ("train", "heldout"))
    assert train + heldout == templates_of("all", TEMPLATES) == TEMPLATES and len(heldout) == 1


@pytest.mark.parametrize("split", ["train", "heldout"])
def test_a_split_draws_only_its_own(split: str) -> None:
    episodes = [sample_episode(EpisodeSpec(seed=seed, split=split)) for seed in range(60)]
    assert {e.target for e in episodes} <= set(targets_of(split))
    assert all(
        e.instruction
        in {
            t.format(color=e.color, row=e.target[0], column=e.target[1])
            for t in templates_of(split, TEMPLATES)
        }
        for e in episodes
        if e.target is not None
    )


def test_a_target_of_the_other_split_is_refused() -> None:
    with pytest.raises(ValueError, match=r"--env\.target=\[0, 3\] is not in --env\.split=train"):
        sample_episode(EpisodeSpec(seed=0, split="train", target=(0, 3)))
