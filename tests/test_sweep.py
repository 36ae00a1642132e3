"""``lerobot-bomb sweep``: jobs are run once, by anybody, and give the records of lerobot-eval."""

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from sweep_cases import FLAGS, NANO, lines_of, small, sweep

from lerobot_bomb.results.groups import read_results
from lerobot_bomb.results.record import Record
from lerobot_bomb.sweep.local import PYTHON, Workers, progress
from lerobot_bomb.sweep.manifest import Manifest, plan
from lerobot_bomb.sweep.store import MAX_ATTEMPTS, Store


def test_a_job_is_of_one_worker_at_a_time(tmp_path: Path) -> None:
    (job,) = small().jobs
    one, other = Store(tmp_path, small()), Store(tmp_path, small())
    with one.claimed(job) as mine, other.claimed(job) as theirs:
        assert mine and not theirs
    with other.claimed(job) as theirs:
        assert theirs


def test_a_job_whose_workers_are_killed_is_given_up_and_can_be_retried(tmp_path: Path) -> None:
    (job,) = small().jobs
    store = Store(tmp_path, small())
    assert [store.begin(job) for _ in range(MAX_ATTEMPTS + 1)] == [True] * MAX_ATTEMPTS + [False]
    assert store.is_over(job) and not store.is_finished(job)
    assert any("workers ended while they ran it; 3 attempts" in line for line in store.lines())
    store.begin_again([job])
    assert not store.is_over(job) and store.begin(job)


def test_a_sweep_that_was_stopped_is_no_failed_attempt(tmp_path: Path) -> None:
    (job,) = small().jobs
    stopped = Store(tmp_path, small())
    for _ in range(MAX_ATTEMPTS):
        assert stopped.begin(job)
    store = Store(tmp_path, small())
    worker = Store(tmp_path, small(), store.run)
    for each in (store, worker, store):
        assert each.begin(job)
    assert not worker.begin(job) and store.is_over(job)


# Running


@pytest.fixture
def run_all(tmp_path: Path) -> Callable[[Manifest], Store]:
    """Run all jobs of a manifest in this process."""
    from lerobot_bomb.sweep.worker import Worker

    def run_all(manifest: Manifest) -> Store:
        store = Store(tmp_path / "sweep", manifest)
        Worker(store).run(list(manifest.jobs))
        store.merge()
        return store

    return run_all


def by_seed(rows: list[Record]) -> list[Record]:
    """Return what is the same whoever runs the episodes."""
    return sorted((replace(each, inference=None) for each in rows), key=lambda row: row.spec.seed)


@pytest.mark.parametrize(
    "policy",
    [
        pytest.param("bomb_random", marks=pytest.mark.long),
        "bomb:fdvla",
        pytest.param(NANO, marks=pytest.mark.long),
        pytest.param("bomb:spatialvla_grid", marks=pytest.mark.long),
    ],
)
def test_the_lines_are_those_of_lerobot_eval(
    policy: str, run_all: Callable[[Manifest], Store], stock_cli: Callable[..., None], tmp_path: Path
) -> None:
    flags = ("--env.type=bomb", "--env.image_size=64", "--env.fps=2", "--policy.device=cpu")
    flags += ("--env.ignore_checkpoint=true",)  # of 10 Hz, whose episodes are five times as long
    conditions = ("none", "light:3", "camera:2")
    manifest = plan((policy,), ("place",), conditions, seed=7, num_episodes=2, batch_size=2, flags=flags)
    store = run_all(manifest)
    # the last of several that one process ran with one policy
    command = [*manifest.jobs[-1].flags, f"--env.results_path={tmp_path / 'stock.jsonl'}"]
    stock_cli("lerobot-eval", *command, f"--output_dir={tmp_path / 'eval'}")
    ours = read_results(store.file(manifest.jobs[-1], "jsonl"))
    assert by_seed(ours) == by_seed(read_results(tmp_path / "stock.jsonl"))
    assert read_results(store.folder / "results.jsonl")


def test_an_episode_that_raises_is_an_error_and_no_failure(
    run_all: Callable[[Manifest], Store], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from lerobot.scripts import lerobot_eval

    rollout = lerobot_eval.rollout

    def raising(*args: Any, seeds: list[int], **options: Any) -> dict:
        if any(seed % 10 == 9 for seed in seeds):
            raise ArithmeticError("the answer is not finite")
        return rollout(*args, seeds=seeds, **options)

    monkeypatch.setattr(lerobot_eval, "rollout", raising)
    manifest = small(n=5)  # seeds 7..11
    store = run_all(manifest)
    rows = read_results(store.folder / "results.jsonl")
    assert [row.spec.seed for row in rows] == [7, 8, 10, 11]
    (error,) = store.errors(manifest.jobs[0])
    assert (error.seed, error.error) == (9, "ArithmeticError: the answer is not finite")
    assert "--seed=9 --eval.n_episodes=1" in error.command
    text = "\n".join(store.lines())
    assert "4 of 5 episodes" in text and "1 x ArithmeticError: the answer is not finite" in text
    monkeypatch.undo()
    store.begin_again(manifest.jobs)
    run_all(manifest)
    assert len(read_results(store.folder / "results.jsonl")) == 5 and not store.errors(manifest.jobs[0])


def test_a_job_that_cannot_begin_is_given_up_at_once(run_all: Callable[[Manifest], Store]) -> None:
    flags = ("--env.type=bomb", "--env.image_size=48", "--policy.device=cpu")  # of a policy of 64
    manifest = plan((NANO, "bomb_expert"), (), ("none",), seed=7, num_episodes=1, batch_size=1, flags=flags)
    store = run_all(manifest)
    assert [store.is_finished(job) for job in manifest.jobs] == [False, True]
    assert any("image_size=64" in line for line in store.lines())


def test_what_a_command_said_before_it_exited_is_the_reason(run_all: Callable[[Manifest], Store]) -> None:
    flags = (*FLAGS, "--env.tsak=place")
    store = run_all(plan(("bomb_expert",), (), ("none",), 7, 1, 1, flags))
    (reason,) = [line for line in store.lines() if "tsak" in line and "given up" not in line]
    assert "unrecognized arguments" in reason


def test_what_workers_warned_of_is_told_once(tmp_path: Path) -> None:
    log, warning = tmp_path / "sweep" / "workers.log", b"WARNING:lerobot_bomb.checkpoints:fps is not known\n"
    store = Store(log.parent, plan(("bomb_random",), (), ("none",), 7, 1, 1, ("--env.type=bomb",)))
    log.write_bytes(b"WARNING:lerobot_bomb:of an earlier command\n")
    workers = Workers(store, [], [], None)
    with log.open("ab") as file:
        file.write(warning + b"WARNING:root:of LeRobot\n" + warning)
    assert workers.warnings() == ["fps is not known"]
    workers.close()


def test_files_that_vanish_while_they_are_counted_do_not_matter(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    manifest = small()
    (job,) = manifest.jobs
    store = Store(tmp_path, manifest)
    store.finish(job, lines_of(job), [])
    store.file(job, "part").write_text("{}\n")
    is_file = Path.is_file

    def then_removed(path: Path) -> bool:
        found = is_file(path)
        store.file(job, "part").unlink(missing_ok=True)
        return found

    monkeypatch.setattr(Path, "is_file", then_removed)
    assert store.num_run([job]) in (3, 4)


def test_lines_of_finished_jobs_are_there_before_the_sweep_has_ended(tmp_path: Path) -> None:
    manifest = small(conditions=("none", "light:3"))
    first, second = manifest.jobs
    store = Store(tmp_path, manifest)
    states = progress(store, manifest.jobs)
    next(states)
    store.finish(first, lines_of(first), [])
    next(states)
    assert (tmp_path / "results.jsonl").read_text().splitlines() == lines_of(first)
    store.file(first, "jsonl").unlink()
    assert not next(states), "a job that is over was counted again"
    store.finish(second, lines_of(second), [])
    assert list(states) == []


def test_a_sweep_ends_with_the_command_that_shows_its_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    small().write(tmp_path)

    def give_up(store: Store, *_: object) -> None:
        store.give_up(store.manifest.jobs[0], "no")

    def finish(store: Store, *_: object) -> None:
        (job,) = store.manifest.jobs
        store.finish(job, lines_of(job), [])

    monkeypatch.setattr("lerobot_bomb.commands.sweep.run_part", give_up)
    assert sweep(tmp_path) == 1
    assert "next:" not in capsys.readouterr().out
    monkeypatch.setattr("lerobot_bomb.commands.sweep.run_part", finish)
    assert sweep(tmp_path) == 0
    results = f"  lerobot-bomb results {tmp_path / 'results.jsonl'}  # rates, changes and failures"
    assert capsys.readouterr().out.splitlines()[-3:] == ["", "next:", results]


def test_sigterm_ends_a_sweep_as_ctrl_c_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    small().write(tmp_path)
    monkeypatch.setattr(
        "lerobot_bomb.commands.sweep.run_part",
        lambda *_: os.kill(os.getpid(), signal.SIGTERM) or time.sleep(9),
    )
    assert sweep(tmp_path) == 130
    printed = capsys.readouterr()
    assert f"to resume: lerobot-bomb sweep {tmp_path}" in printed.out and "interrupted" in printed.err
    assert (tmp_path / "results.jsonl").read_text() == ""


@pytest.mark.long
def test_killed_at_any_moment_the_lines_are_those_of_an_undisturbed_run(tmp_path: Path) -> None:
    command = [Path(sys.executable).with_name("lerobot-bomb"), "sweep"]
    flags = ["--policies=bomb_expert,bomb_random", "--perturbations=none,light:3,all:3", "--episodes=10"]
    flags += ["--workers=2", *FLAGS]
    subprocess.run([*command, tmp_path / "undisturbed", *flags], check=True, capture_output=True)
    expected = (tmp_path / "undisturbed" / "results.jsonl").read_text()
    moments = random.Random(0)
    for _ in range(20):
        run = subprocess.Popen(
            [*command, tmp_path / "killed", *flags], stdout=subprocess.PIPE, start_new_session=True
        )
        time.sleep(moments.uniform(1, 20))
        if moments.random() < 0.5:
            os.killpg(run.pid, signal.SIGKILL)  # with its workers
        run.kill()
        run.wait()
    subprocess.run([*command, tmp_path / "killed", "--retry", "--workers=2"], check=True, capture_output=True)
    assert (tmp_path / "killed" / "results.jsonl").read_text() == expected


def test_a_worker_whose_parent_is_gone_imports_nothing(tmp_path: Path) -> None:
    command = [*PYTHON, "lerobot_bomb.sweep", str(tmp_path), "1/1", "run", "1"]
    shown = os.environ | {"PYTHONPROFILEIMPORTTIME": "1"}
    ended = subprocess.run(
        command, stdin=subprocess.DEVNULL, env=shown, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 1
    assert "threading" in ended.stderr and "lerobot.envs" not in ended.stderr
