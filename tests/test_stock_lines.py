"""LeRobot's own `pusht` and `libero` in a sweep, and as records."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from lerobot.envs.configs import AlohaEnv, LiberoEnv, PushtEnv
from pusht_checkpoints import write_act

from lerobot_bomb.commands.main import main
from lerobot_bomb.evaluation.eval_info import results_of
from lerobot_bomb.libero.assets import Libero
from lerobot_bomb.results.comparison import compare
from lerobot_bomb.results.groups import read_results
from lerobot_bomb.results.origin import PolicyIdentity
from lerobot_bomb.results.reading import parse_record
from lerobot_bomb.results.stock import StockLiberoResult, StockPushTResult
from lerobot_bomb.sweep.manifest import Manifest, plan
from lerobot_bomb.sweep.store import Store

pytest.importorskip("gym_pusht", reason="gym-pusht is not installed: pip install '.[pusht]'")

FLAGS = ("--env.type=pusht", "--env.episode_length=6", "--policy.device=cpu")
SEEDS = [7, 8, 9, 10]
ACT = PolicyIdentity("act")


def info(suite: str, task_id: int, rewards: list[float]) -> dict[str, Any]:
    """Return what lerobot-eval writes of a task, whose episode is a success with a reward of 1."""
    successes = [reward == 1 for reward in rewards]
    metrics = {"sum_rewards": rewards, "max_rewards": rewards, "successes": successes}
    return {"per_task": [{"task_group": suite, "task_id": task_id, "metrics": metrics}]}


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_act(tmp_path_factory.mktemp("pusht") / "act")


@pytest.fixture
def manifest(checkpoint: Path) -> Manifest:
    return plan((str(checkpoint),), (), (), seed=SEEDS[0], num_episodes=4, batch_size=2, flags=FLAGS)


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


def test_a_sweep_gives_the_lines_that_are_made_of_the_printed_command(
    manifest: Manifest, run_all: Callable[[Manifest], Store], stock_cli: Callable[..., None], tmp_path: Path
) -> None:
    store = run_all(manifest)
    (job,) = manifest.jobs
    assert "results_path" not in job.command
    flags = [*job.flags, f"--output_dir={tmp_path / 'eval'}"]
    stock_cli("lerobot-eval", *flags)
    assert main(["results", "add", str(tmp_path / "stock.jsonl"), *flags]) == 0
    assert (store.folder / "results.jsonl").read_text() == (tmp_path / "stock.jsonl").read_text()
    rows = read_results(tmp_path / "stock.jsonl", StockPushTResult)
    assert [row.spec.seed for row in rows] == SEEDS
    assert [row.policy and row.policy.batch_row for row in rows] == [0, 1, 0, 1]
    (task,) = json.loads((tmp_path / "eval" / "eval_info.json").read_text())["per_task"]
    assert [row.max_reward for row in rows] == task["metrics"]["max_rewards"]
    assert [row.sum_reward for row in rows] == task["metrics"]["sum_rewards"]
    assert all(row.flags["episode_length"] == 6 and row.image_size == "96x96" for row in rows)
    assert all(row.policy and row.policy.weights_sha256 for row in rows)


def test_results_compare_and_report_read_the_lines(
    manifest: Manifest,
    run_all: Callable[[Manifest], Store],
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    lines = (run_all(manifest).folder / "results.jsonl").read_text()
    first, second = tmp_path / "first.jsonl", tmp_path / "second.jsonl"
    first.write_text(lines)
    rows = [json.loads(line) for line in lines.splitlines()]
    for row in rows:
        row["policy"] |= {"path": "outputs/other", "weights_sha256": "0" * 64}
        row |= {"is_success": True, "failure": None, "max_reward": 1.0}
    second.write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert main(["results", str(first), "--verbose"]) == 0
    printed = capsys.readouterr().out
    assert "pusht tasks 0" in printed and "success          0/4 = 0.0 %" in printed
    assert "max reward" in printed and "failed 4" in printed
    assert main(["compare", str(first), str(second)]) == 0
    assert "B alone in 4 of 4 pairs" in capsys.readouterr().out
    assert main(["report", str(first), str(second), f"--output={tmp_path / 'report.html'}"]) == 0
    page = (tmp_path / "report.html").read_text()
    assert "--env.type=pusht" in page and "--env.perturbations" not in page


def test_an_episode_that_raises_is_an_error_and_no_failure(
    manifest: Manifest, run_all: Callable[[Manifest], Store], monkeypatch: pytest.MonkeyPatch
) -> None:
    from lerobot.scripts import lerobot_eval

    rollout = lerobot_eval.rollout

    def raising(*args: Any, seeds: list[int], **options: Any) -> dict:
        if 9 in seeds:
            raise RuntimeError("out of memory")
        return rollout(*args, seeds=seeds, **options)

    monkeypatch.setattr(lerobot_eval, "rollout", raising)
    store = run_all(manifest)
    (error,) = store.errors(manifest.jobs[0])
    assert (error.seed, error.error) == (9, "RuntimeError: out of memory")
    assert "--seed=9 --eval.n_episodes=1" in error.command
    assert [row.spec.seed for row in read_results(store.folder / "results.jsonl")] == [7, 8, 10]
    monkeypatch.undo()
    store.begin_again(manifest.jobs)
    assert len(read_results(run_all(manifest).folder / "results.jsonl")) == 4


def test_actions_that_are_not_finite_are_errors(
    manifest: Manifest, run_all: Callable[[Manifest], Store], monkeypatch: pytest.MonkeyPatch
) -> None:
    from lerobot.policies.act.modeling_act import ACTPolicy

    select = ACTPolicy.select_action
    monkeypatch.setattr(ACTPolicy, "select_action", lambda *args: select(*args) * float("nan"))
    store = run_all(manifest)
    errors = store.errors(manifest.jobs[0])
    assert [error.seed for error in errors] == SEEDS
    assert {error.error for error in errors} == {"ArithmeticError: an action of the policy is not finite"}


def test_a_reward_that_is_not_finite_is_named_by_its_seed() -> None:
    with pytest.raises(ValueError, match="the rewards of seed 8 are not finite"):
        list(results_of(info("pusht", 0, [1.0, float("nan")]), PushtEnv(), ACT, 7, 2))
    told = info("pusht", 0, [1.0])
    told["per_task"][0]["metrics"]["sum_rewards"] = [float("inf")]  # one of the two is enough
    with pytest.raises(ValueError, match="the rewards of seed 7 are not finite"):
        list(results_of(told, PushtEnv(), ACT, 7, 1))
    (result,) = results_of(info("pusht", 0, [1.0]), PushtEnv(), ACT, 7, 1)
    assert result.spec.number is None  # its seed alone chooses how an episode starts


def test_libero_is_told_apart_by_the_number_that_chooses_the_initial_state() -> None:
    results = results_of(
        info("libero_goal", 3, [1.0, 0.0]), LiberoEnv(task="libero_goal"), ACT, 7, 1, first=2
    )
    rows = [result for result in results if isinstance(result, StockLiberoResult)]
    assert rows == [parse_record(row.to_json().encode()) for row in rows]
    assert [vars(row.spec) for row in rows] == [
        {"seed": seed, "suite": "libero_goal", "task_id": 3, "number": number, "perturbations": "none"}
        for seed, number in ((7, 2), (8, 3))
    ]
    assert [row.failure for row in rows] == [None, "failed"]
    assert rows[0].image_size == "360x360" and "task" not in rows[0].flags
    assert StockLiberoResult.describe_simulator({"simulator": "robosuite 1"}) == "robosuite 1"
    flags = StockLiberoResult.eval_flags(rows)
    assert flags[0] == "--env.type=libero" and flags[-1] == "--eval.use_async_envs=false"
    assert "--env.task=libero_goal" in flags and "--env.task_ids=[3]" in flags


def test_a_flag_without_value_differs_from_both_sides() -> None:
    a, b = (
        [*results_of(info("libero_goal", 3, [1.0]), LiberoEnv(episode_length=length), policy, 7, 1)]
        for length, policy in ((None, ACT), (100, replace(ACT, type="other")))
    )
    for sides in ((a, b), (b, a)):
        with pytest.raises(ValueError, match="no episode is in both: they differ in episode_length"):
            compare(*sides)


def test_an_env_type_of_which_nothing_is_known_has_success_and_rewards(tmp_path: Path) -> None:
    rows = list(results_of(info("aloha", 0, [1.0, 0.0]), AlohaEnv(episode_length=9), ACT, 7, 2))
    assert rows == [parse_record(row.to_json().encode()) for row in rows]
    assert [(row.spec.seed, row.max_reward, row.failure) for row in rows] == [(7, 1, None), (8, 0, "failed")]
    assert {(row.protocol_version, row.image_size) for row in rows} == {("lerobot-aloha-1.0", "640x480")}
    assert rows[0].simulator_versions["gymnasium"] and "gym_aloha" not in rows[0].simulator_versions
    flags = rows[0].eval_flags(rows)
    assert flags[0] == "--env.type=aloha" and "--env.episode_length=9" in flags
    path = tmp_path / "aloha.jsonl"
    path.write_text("".join(f"{row.to_json()}\n" for row in rows))
    assert main(["export", str(path), f"--output={tmp_path}"]) == 0


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--env.type=pusht"], "--output_dir=... is missing"),
        (["--env.type=bomb", "--output_dir=."], "lerobot-eval writes its records itself"),
        (["--env.type=pusht", "--output_dir=.", "--seed=null"], "--seed=null: episodes without a seed"),
        (
            ["--env.type=libero", "--output_dir=.", "--eval.batch_size=2"],
            "is determined with --eval.batch_size=1 only",
        ),
        (["--env.type=pusht", "--output_dir=gone"], "gone has no eval_info.json"),
        (
            ["--env.type=pusht", "--output_dir=other", "--eval.n_episodes=4"],
            "has 2 episodes of a task, --eval.n_episodes says 4",
        ),
        (["--env.type=pusht", "--output_dir=something"], "has no episodes in it"),
    ],
)
def test_what_is_no_such_evaluation_is_told(
    flags: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, content in (("other", info("pusht", 0, [1.0, 0.0])), ("something", {})):
        (tmp_path / name).mkdir()
        (tmp_path / name / "eval_info.json").write_text(json.dumps(content))
    assert main(["results", "add", "lines.jsonl", "--policy.type=bomb_random", *flags]) == 1
    assert message in capsys.readouterr().err
    assert not (tmp_path / "lines.jsonl").exists()


@pytest.mark.long
def test_libero_is_run_from_the_initial_states_in_order(
    libero_with_assets: Libero, run_all: Callable[[Manifest], Store], monkeypatch: pytest.MonkeyPatch
) -> None:
    from lerobot_env_bomb.shared.backend import ensure_gl_backend

    ensure_gl_backend()  # before robosuite imports MuJoCo
    from lerobot.envs import libero
    from lerobot.scripts import lerobot_eval

    started: list[int] = []
    reset, rollout = libero.LiberoEnv.reset, lerobot_eval.rollout

    def noted(self: Any, *args: Any, **options: Any) -> Any:
        started.append(self.init_state_id)
        return reset(self, *args, **options)

    def raising(*args: Any, seeds: list[int], **options: Any) -> dict:
        if seeds == [9] and len(started) < 3:
            raise RuntimeError("once")
        return rollout(*args, seeds=seeds, **options)

    monkeypatch.setattr(libero.LiberoEnv, "reset", noted)
    monkeypatch.setattr(lerobot_eval, "rollout", raising)
    flags = ("--env.type=libero", "--env.task_ids=[0]", "--env.episode_length=2", "--policy.device=cpu")
    flags += ("--env.observation_height=48", "--env.observation_width=48", "--policy.vlm_model_name=nano")
    flags += ("--policy.use_state=false",)
    policies = ("vla0_smol",)
    store = run_all(
        plan(policies, ("libero_spatial",), (), seed=7, num_episodes=3, batch_size=1, flags=flags)
    )
    rows = read_results(store.folder / "results.jsonl", StockLiberoResult)
    assert [(row.spec.seed, row.spec.number) for row in rows] == [(7, 0), (8, 1), (9, 2)]
    # the third raised in the evaluation of all, then each was run alone
    assert started == [0, 1, 0, 1, 2]
