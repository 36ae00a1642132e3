"""``lerobot-bomb sweep``: its plan, the flags that it refuses, and the folder with its manifest."""

import json
import re
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
from sweep_cases import FLAGS, NANO, lines_of, small, sweep

from lerobot_bomb.commands.main import EVAL_FLAGS
from lerobot_bomb.commands.results_files import missing_of_sweep
from lerobot_bomb.sweep.claim import claimed
from lerobot_bomb.sweep.manifest import Job, Manifest, plan, policy_flag
from lerobot_bomb.sweep.store import EpisodeError, Store


def test_a_plan_is_every_policy_on_every_task_under_every_condition() -> None:
    manifest = plan(("bomb:fdvla", "act"), ("place", "object"), ("none", "light:3"), 5, 20, 8, FLAGS)
    assert len(manifest.jobs) == 8 and manifest.num_records == 160
    first = manifest.jobs[0]
    assert first.flags == [
        "--policy.path=bomb:fdvla", "--policy.device=cpu", "--env.type=bomb", "--env.image_size=32",
        "--env.task=place", '--env.perturbations=["none"]', "--seed=5", "--eval.n_episodes=20",
        "--eval.batch_size=5", "--eval.use_async_envs=false",
    ]  # fmt: skip
    assert manifest.jobs[-1].policy[0] == "--policy.type=act"


@pytest.mark.parametrize(
    ("flags", "num_tasks"),
    [
        (("--env.type=bomb_libero",), 10),
        (("--env.type=bomb_libero", "--env.task=libero_90"), 90),
        (("--env.type=bomb_libero", "--env.task_ids=[3,7]"), 2),
        (("--env.type=libero", "--env.task=libero_goal"), 10),
        (("--env.type=bomb", "--env.task=all"), 5),
        (("--env.type=bomb", "--env.task=goal", "--env.task_ids=[4]"), 1),
        (("--env.type=bomb_pusht",), 1),
        (("--env.type=aloha",), 1),
    ],
)
def test_a_job_runs_its_episodes_in_each_of_its_tasks(flags: tuple[str, ...], num_tasks: int) -> None:
    assert Job(("--policy.type=act",), flags, 0, 20, 1).num_records == 20 * num_tasks


def test_jobs_have_names_of_their_own() -> None:
    jobs = small(("bomb_expert", "bomb:fdvla"), ("none", "camera:3", "camera:2+light:3")).jobs
    assert len({job.key for job in jobs}) == 6
    assert Job(("--policy.type=a/b",), ("--env.type=c d",), 0, 1, 1).key.isascii()


def test_dry_run_prints_the_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flags = ["--policies=bomb_expert", "--perturbations=none,each:2-3", "--episodes=4", "--dry_run", *FLAGS]
    assert sweep(tmp_path, *flags) == 0
    commands = capsys.readouterr().out.splitlines()
    assert len(commands) == 1 + 10 * 2
    assert all(command.startswith("lerobot-eval --policy.type=bomb_expert") for command in commands)
    assert "camera:2" in "".join(commands) and "goal_marker" not in "".join(commands)


def test_every_env_type_of_lerobots_can_be_swept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        sweep(tmp_path, "--policies=act", "--env.type=aloha", "--tasks=AlohaInsertion-v0", "--dry_run") == 0
    )
    assert "--env.type=aloha --env.task=AlohaInsertion-v0 --seed=1000" in capsys.readouterr().out


@pytest.mark.parametrize(("flags", "size"), [((), 1), (("--batch_size=4",), 4)])
def test_an_environment_chooses_its_batches(
    flags: tuple[str, ...], size: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    env = ("--env.type=bomb_libero", "--tasks=libero_spatial", "--episodes=8", "--dry_run")
    assert sweep(tmp_path, "--policies=bomb_expert", *env, *flags) == 0
    assert f"--eval.batch_size={size} " in capsys.readouterr().out


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


# Flags that are refused


@pytest.mark.parametrize(
    "flag", ["--seed=3", "--eval.n_episodes=4", "--policy.path=x", "--env.results_path=y"]
)
def test_what_the_sweep_sets_itself_is_refused_as_a_flag(flag: str) -> None:
    with pytest.raises(ValueError, match="is set for every job"):
        plan(("act",), (), (), 0, 1, 1, [flag])


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


# The manifest and its folder


def test_a_changed_job_is_another_job(tmp_path: Path) -> None:
    before, after = small(n=3), small(n=4)
    store = Store(tmp_path, before)
    store.finish(before.jobs[0], lines_of(before.jobs[0]), [])
    changed = Store(tmp_path, after)
    assert not changed.is_finished(after.jobs[0])
    assert any("the manifest has changed: 1 jobs" in line for line in changed.lines())


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
    error = EpisodeError(manifest.jobs[0].key, 7, "ValueError", "lerobot-eval").to_json()
    (tmp_path / "errors.jsonl").write_text(f"{error}\n{error}\n")
    again = f"`lerobot-bomb sweep {tmp_path} --retry` runs them again"
    errors = f"an error ended 2: {tmp_path / 'errors.jsonl'}, {again}"
    assert missing_of_sweep(results, 4) == f"{results}: 2 of 6 episodes are missing; {errors}"
    assert missing_of_sweep(tmp_path / "other.jsonl", 2) == ""
    (tmp_path / "errors.jsonl").write_text("{}\n")
    assert "whether episodes are missing cannot be said: " in missing_of_sweep(results, 2)
    (tmp_path / "errors.jsonl").unlink()
    (tmp_path / "manifest.json").write_text('{"version"')
    assert "whether episodes are missing cannot be said: " in missing_of_sweep(results, 2)


def test_an_error_ends_an_episode_of_every_task(tmp_path: Path) -> None:
    flags = (*FLAGS, "--env.task_ids=[0,3]")
    manifest = plan(
        ("bomb_expert",), ("place",), ("none",), seed=7, num_episodes=3, batch_size=1, flags=flags
    )
    manifest.write(tmp_path)
    store, (job,) = Store(tmp_path, manifest), manifest.jobs
    store.finish(job, 2 * lines_of(job)[:2], [EpisodeError(job.key, 9, "ValueError", "lerobot-eval")])
    store.merge()
    assert "2 episodes have no result" in "\n".join(store.lines())
    missing = missing_of_sweep(tmp_path / "results.jsonl", 4)
    assert "2 of 6 episodes are missing; an error ended 2: " in missing and "resumes" not in missing
