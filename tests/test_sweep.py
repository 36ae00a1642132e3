"""``lerobot-bomb sweep``: jobs are run once, by anybody, and give the records of lerobot-eval."""

import json
import os
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from lerobot_bomb.commands.main import EVAL_FLAGS, main
from lerobot_bomb.commands.results_files import missing_of_sweep
from lerobot_bomb.results.groups import read_results
from lerobot_bomb.results.record import Record, without_measured
from lerobot_bomb.sweep.claim import claimed
from lerobot_bomb.sweep.local import PYTHON, Workers, progress
from lerobot_bomb.sweep.manifest import Job, Manifest, plan, policy_flag
from lerobot_bomb.sweep.store import MAX_ATTEMPTS, Store

FLAGS = ("--env.type=bomb", "--env.image_size=32", "--policy.device=cpu")
NANO = "bomb:vla0_smol"


def small(
    policies: tuple[str, ...] = ("bomb_expert",), conditions: tuple[str, ...] = ("none",), n: int = 3
) -> Manifest:
    return plan(policies, ("place",), conditions, seed=7, num_episodes=n, batch_size=10, flags=FLAGS)


def lines_of(job: Job) -> list[str]:
    """Return as many lines as the job has episodes."""
    return [json.dumps({"spec": {"seed": seed}}) for seed in job.seeds]


def sweep(*flags: str | Path) -> int:
    return main(["sweep", *map(str, flags)])


# The manifest


def test_a_plan_is_every_policy_on_every_task_under_every_condition() -> None:
    manifest = plan(("bomb:fdvla", "act"), ("place", "object"), ("none", "light:3"), 5, 20, 8, FLAGS)
    assert len(manifest.jobs) == 8 and manifest.num_episodes == 160
    first = manifest.jobs[0]
    assert first.flags == [
        "--policy.path=bomb:fdvla", "--policy.device=cpu", "--env.type=bomb", "--env.image_size=32",
        "--env.task=place", '--env.perturbations=["none"]', "--seed=5", "--eval.n_episodes=20",
        "--eval.batch_size=5", "--eval.use_async_envs=false",
    ]  # fmt: skip
    assert manifest.jobs[-1].policy[0] == "--policy.type=act"


def test_a_manifest_is_read_as_it_was_written(tmp_path: Path) -> None:
    manifest = small(("bomb:fdvla", "bomb_random"), ("none", "all:1-5"))
    manifest.write(tmp_path)
    assert Manifest.read(tmp_path) == manifest


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": -1}, "seed=-1 must be a whole number from 0 on"),
        ({"num_episodes": "many"}, "num_episodes='many' must be a whole number from 1 on"),
        ({"seed": 8}, "its command is not that of its flags"),
        ({"env": None}, "a job is damaged"),
    ],
)
def test_a_manifest_that_was_damaged_is_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    small().write(tmp_path)
    path = tmp_path / "manifest.json"
    values = json.loads(path.read_text())
    values["cells"][0] |= change
    path.write_text(json.dumps(values))
    with pytest.raises(ValueError, match=message):
        Manifest.read(tmp_path)


@pytest.mark.parametrize(
    "flag", ["--seed=3", "--eval.n_episodes=4", "--policy.path=x", "--env.results_path=y"]
)
def test_what_the_sweep_sets_itself_is_refused_as_a_flag(flag: str) -> None:
    with pytest.raises(ValueError, match="is set for every job"):
        plan(("act",), (), (), 0, 1, 1, [flag])


def test_dry_run_prints_the_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flags = ["--policies=bomb_expert", "--perturbations=none,each:2-3", "--episodes=4", "--dry_run", *FLAGS]
    assert sweep(tmp_path, *flags) == 0
    commands = capsys.readouterr().out.splitlines()
    assert len(commands) == 1 + 10 * 2
    assert all(command.startswith("lerobot-eval --policy.type=bomb_expert") for command in commands)
    assert "camera:2" in "".join(commands) and "goal_marker" not in "".join(commands)


# Who runs what


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
    assert any("3 workers ended while they ran it" in line for line in store.lines())
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


def test_a_changed_job_is_another_job(tmp_path: Path) -> None:
    before, after = small(n=3), small(n=4)
    store = Store(tmp_path, before)
    store.finish(before.jobs[0], lines_of(before.jobs[0]), [])
    changed = Store(tmp_path, after)
    assert not changed.is_finished(after.jobs[0])
    assert any("the manifest has changed: 1 jobs" in line for line in changed.lines())


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
    return sorted(map(without_measured, rows), key=lambda row: row.spec.seed)


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


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ([], "holds no manifest.json: begin a sweep with"),
        (["--policies=bomb_expert"], "--env.type is missing"),
        (["--policies=bomb_expert", "--env.type=bomb", "--perturbations=fog:3"], "'fog' is not an axis"),
        (["--policies=bomb_expert", "--env.type=bomb", "--perturbations=each:0"], "write each:LEVEL"),
        (
            ["--policies=act", "--env.type=pusht", "--perturbations=camera:3"],
            "--env.type=pusht has none; --env.type=bomb_pusht has",
        ),
        (
            ["--policies=bomb_expert", "--env.type=bomb", "--tasks=place,plaec"],
            "--env.task='plaec' is unknown; choose one of: goal, long, object, place, spatial, all",
        ),
        (["--policies=bomb_expert", "--env.type=bomb", "--episodes=0"], "--episodes=0 must be at least 1"),
        (["--policies=/gone", "--env.type=bomb"], "--policies: /gone is no folder"),
        (["--policies=bomb:fdvl", "--env.type=bomb"], "no checkpoint 'fdvl' comes with this package"),
        (["--policies=act", "--env.type=pusht", "--seed=-1"], "--seed=-1 must be at least 0"),
        (["--policies=README.md", "--env.type=bomb"], "--policies: README.md is no"),
        (["--policies=bomb_expert", "--env.type=bomb", "--shard=4/4"], "--shard: 4/4 must be PART/PARTS"),
        (["--policies=bomb_expert", "--env.type=bomb", "--shard=²/4"], "--shard: ²/4 must be PART/PARTS"),
        (["--policies=bomb_expert", "--env.type=bomb", "--timeout=0"], "--timeout=0 must be at least 1"),
        (["--policies=bomb_expert", "--env.type=bomb", "--timeout=-5"], "--timeout=-5 must be at least 1"),
        (["--policies=,", "--env.type=bomb"], "--policies names none"),
        (
            ["--policies=act", "--env.type=pusht", "--seed=4294967290"],
            "--seed=4294967290 and --episodes=20: the last seed is 4294967295",
        ),
    ],
)
def test_wrong_flags_are_told(
    flags: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert sweep(tmp_path, *flags) == 1
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_every_env_type_of_lerobots_can_be_swept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        sweep(tmp_path, "--policies=act", "--env.type=aloha", "--tasks=AlohaInsertion-v0", "--dry_run") == 0
    )
    assert "--env.type=aloha --env.task=AlohaInsertion-v0 --seed=1000" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--polices=bomb_expert"], "--polices=bomb_expert; nearest: --policies"),
        (["--policies=bomb_expert", "--epsiodes=3"], "--epsiodes=3; nearest: --episodes"),
        (["--policies=bomb_expert", "--taks=place"], "--taks=place; nearest: --tasks"),
    ],
)
def test_misspelt_flags_of_its_own_are_told(
    flags: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        sweep(tmp_path, *flags, "--env.type=bomb")
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_the_flags_that_may_be_lerobots_without_a_group_are_those_that_it_has() -> None:
    from lerobot.configs.eval import EvalPipelineConfig

    names = {each.name for each in fields(EvalPipelineConfig)} - {"env", "eval", "policy"}
    assert set(EVAL_FLAGS) == {f"--{name}" for name in names | {"config_path"}}


@pytest.mark.parametrize(
    ("policies", "tasks", "flags", "message"),
    [
        (("bomb_expert", NANO), (), ("--env.type=bomb", "--env.image_size=48"), "--env.image_size=64"),
        (
            (NANO,),
            ("place", "object"),
            ("--env.type=bomb", "--env.image_size=64"),
            "evaluate with --env.task=place, or",
        ),
        ((NANO,), (), ("--env.type=bomb_pusht",), "this is --env.type=bomb_pusht"),
    ],
)
def test_a_checkpoint_of_another_environment_is_told_before_anything_is_run(
    policies: tuple[str, ...], tasks: tuple[str, ...], flags: tuple[str, ...], message: str
) -> None:
    from lerobot_bomb.sweep.check import check

    with pytest.raises(ValueError, match=message) as error:
        check(plan(policies, tasks, ("none", "all:3"), 7, 1, 1, flags))
    assert str(error.value).endswith("or override with --env.ignore_checkpoint=true")
    check(plan(policies, tasks, ("none",), 7, 1, 1, (*flags, "--env.ignore_checkpoint=true")))


def test_a_sweep_that_is_refused_says_why_and_leaves_its_folder_free(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = ["--policies=bomb_expert", "--env.type=bomb", "--episodes=1", "--dry_run"]
    assert sweep(tmp_path, *flags[:-1], "--env.imgae_size=64") == 1
    assert "unrecognized arguments: --env.imgae_size=64; nearest: --env.image_size" in capsys.readouterr().err
    assert sweep(tmp_path, *flags, "--env.image_size=64") == 0


def test_a_folder_is_a_checkpoint_or_told_and_stands_for_no_type(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = f"--policies: {tmp_path} holds no config.json; give the folder that lerobot-train names"
    with pytest.raises(ValueError, match=re.escape(told)):
        policy_flag(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "act").mkdir()
    assert policy_flag("act") == "--policy.type=act"
    (tmp_path / "act" / "config.json").touch()
    assert policy_flag("act") == "--policy.path=act"


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


def test_a_folder_of_another_sweep_is_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    manifest = small()
    manifest.write(tmp_path)
    Store(tmp_path, manifest).finish(manifest.jobs[0], lines_of(manifest.jobs[0]), [])
    assert sweep(tmp_path, "--policies=bomb_random", "--dry_run", *FLAGS) == 1
    assert "is of another sweep: of its jobs these flags lack 1, as lerobot-eval" in capsys.readouterr().err
    assert Manifest.read(tmp_path) == manifest


def test_a_folder_where_nothing_was_run_takes_another_sweep(tmp_path: Path) -> None:
    misspelt, other = small(), small(("bomb_random",))
    with claimed(tmp_path, misspelt) as store:
        store.give_up(misspelt.jobs[0], "no such flag")
        assert "takes a sweep with other flags" in store.lines()[-1]
    outliving = Store(tmp_path, misspelt).claimed(misspelt.jobs[0])
    with outliving, pytest.raises(ValueError, match="is of another sweep"), claimed(tmp_path, other):
        pass
    with claimed(tmp_path, other) as store:
        assert store.manifest == Manifest.read(tmp_path) == other


def test_readers_say_what_a_sweep_that_was_stopped_lacks(tmp_path: Path) -> None:
    manifest = small(conditions=("none", "light:3"))
    manifest.write(tmp_path)
    results = tmp_path / "results.jsonl"
    assert missing_of_sweep(results, 6) == ""
    assert missing_of_sweep(results, 2) == (
        f"{results}: 4 of 6 episodes are missing; `lerobot-bomb sweep {tmp_path}` resumes"
    )
    (tmp_path / "errors.jsonl").write_text("{}\n{}\n")
    errors = f"an error ended 2: {tmp_path / 'errors.jsonl'}"
    assert missing_of_sweep(results, 4) == f"{results}: 2 of 6 episodes are missing; {errors}"
    assert missing_of_sweep(tmp_path / "other.jsonl", 2) == ""
    (tmp_path / "manifest.json").write_text('{"version"')
    assert "whether episodes are missing cannot be said: " in missing_of_sweep(results, 2)


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


def test_jobs_have_names_of_their_own() -> None:
    jobs = small(("bomb_expert", "bomb:fdvla"), ("none", "camera:3", "camera:2+light:3")).jobs
    assert len({job.key for job in jobs}) == 6
    assert Job(("--policy.type=a/b",), ("--env.type=c d",), 0, 1, 1).key.isascii()


def test_what_a_command_said_before_it_exited_is_the_reason(run_all: Callable[[Manifest], Store]) -> None:
    flags = (*FLAGS, "--env.tsak=place")
    store = run_all(plan(("bomb_expert",), (), ("none",), 7, 1, 1, flags))
    (reason,) = [line for line in store.lines() if "tsak" in line and "given up" not in line]
    assert "unrecognized arguments" in reason


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
