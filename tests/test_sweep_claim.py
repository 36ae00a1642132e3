"""Claims on a sweep's folder, and how a finished sweep grows."""

from pathlib import Path

import pytest
from sweep_cases import FLAGS, lines_of, small, sweep

from lerobot_bomb.sweep.claim import claimed
from lerobot_bomb.sweep.manifest import Manifest, plan

PLAY = ("--dry_run", "--seed=7", "--tasks=place", *FLAGS)


def finish(folder: Path, manifest: Manifest) -> None:
    """Finish every job as if all had been run."""
    with claimed(folder, manifest) as store:
        for job in manifest.jobs:
            store.finish(job, lines_of(job), [])


def test_what_is_named_twice_is_run_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flags = ("--policies=bomb_expert,bomb_expert", "--perturbations=light:3,each:3,none,none", *PLAY)
    for _ in range(2):
        assert sweep(tmp_path, *flags) == 0
        assert len(capsys.readouterr().out.splitlines()) == 11
    assert sweep(tmp_path, "--dry_run") == 0


def test_a_manifest_with_a_job_twice_cannot_be_written() -> None:
    with pytest.raises(ValueError, match="a job is there twice"):
        Manifest(small().jobs * 2)


def test_a_part_without_jobs_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        sweep(tmp_path, "--policies=bomb_expert", "--perturbations=none,light:3", "--shard=9/10", *PLAY) == 1
    )
    assert "--shard: 9/10 has no job: there are 2, so take at most as many parts" in capsys.readouterr().err


# It grows


def test_a_finished_sweep_takes_more_policies_and_conditions(tmp_path: Path) -> None:
    finish(tmp_path, small(("bomb_expert",), ("light:3",)))
    flags = ("--policies=bomb_random,bomb_expert", "--perturbations=none,light:3", "--episodes=3", *PLAY)
    assert sweep(tmp_path, *flags) == 0
    manifest = Manifest.read(tmp_path)
    assert manifest == small(("bomb_random", "bomb_expert"), ("none", "light:3"))
    with claimed(tmp_path, manifest) as store:
        assert [store.is_finished(job) for job in manifest.jobs] == [False, False, False, True]


def test_a_finished_sweep_takes_more_episodes(tmp_path: Path) -> None:
    finish(tmp_path, small(n=3))
    for episodes, expected in ((13, [(7, 3, 3), (10, 10, 10)]), (16, [(7, 3, 3), (10, 10, 10), (20, 3, 3)])):
        for _ in range(2):  # the same command goes on
            assert sweep(tmp_path, "--policies=bomb_expert", f"--episodes={episodes}", *PLAY, *NONE) == 0
        manifest = Manifest.read(tmp_path)
        assert [(job.seed, job.num_episodes, job.batch_size) for job in manifest.jobs] == expected
    with claimed(tmp_path, manifest) as store:
        assert [store.is_finished(job) for job in manifest.jobs] == [True, False, False]


NONE = ("--perturbations=none",)


@pytest.mark.parametrize(
    "flags",
    [
        ("--policies=bomb_expert", "--episodes=2"),
        ("--policies=bomb_random", "--episodes=3"),
        ("--policies=bomb_expert", "--episodes=3", "--env.fps=10"),
        ("--policies=bomb_expert", "--episodes=6", "--batch_size=1"),
        ("--policies=bomb_expert", "--episodes=6", "--seed=8"),
    ],
)
def test_what_has_been_run_is_in_what_it_grows_to(
    flags: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    finish(tmp_path, small(n=3))
    assert sweep(tmp_path, *PLAY, *NONE, *flags) == 1
    assert "is of another sweep: of its jobs these flags lack 1, as lerobot-eval" in capsys.readouterr().err
    assert Manifest.read(tmp_path) == small(n=3)


def test_jobs_whose_episodes_start_by_their_number_do_not_grow(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    env = ("--env.type=libero",)
    finish(tmp_path, plan(("act",), ("libero_goal",), (), 7, num_episodes=3, batch_size=1, flags=env))
    flags = ("--policies=act", "--tasks=libero_goal", "--seed=7", "--dry_run", *env)
    assert sweep(tmp_path, *flags, "--episodes=6") == 1
    assert "--episodes=6: jobs of --env.type=libero do not grow" in capsys.readouterr().err
    assert sweep(tmp_path, *flags, "--episodes=3") == 0


# Two at once


def test_a_second_sweep_of_other_jobs_is_told_and_changes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with claimed(tmp_path, small()):  # has begun nothing yet
        assert sweep(tmp_path, "--policies=bomb_random", "--episodes=3", *PLAY, *NONE) == 1
        assert f"another command is running other jobs in {tmp_path} now" in capsys.readouterr().err
        assert Manifest.read(tmp_path) == small()
    assert sweep(tmp_path, "--policies=bomb_random", "--episodes=3", *PLAY, *NONE) == 0


def test_a_second_sweep_of_the_same_jobs_is_told_that_it_shares_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with claimed(tmp_path, small()):
        assert capsys.readouterr().err == ""
        assert sweep(tmp_path, "--dry_run") == 0
        assert f"another command runs jobs of {tmp_path} now; both share them" in capsys.readouterr().err
