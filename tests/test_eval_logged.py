"""``lerobot-bomb results actions`` and the file it writes."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.observation import RenderOptions
from lerobot_bomb.commands.main import main
from lerobot_bomb.commands.results_actions import LoggedVectorEnv
from lerobot_bomb.envs.rollout import make_env
from lerobot_bomb.evaluation.executed import append_episode, read_executed
from lerobot_bomb.results.bomb import EpisodeResult
from lerobot_bomb.results.groups import read_results
from lerobot_bomb.smoothness import smoothness

MAX_STEPS = 4


class CountingVectorEnv:
    """Vector of two environments; the first terminates after two steps, and then in every step."""

    num_envs = 2

    def reset(self, *, seed: list[int], options: dict | None = None) -> tuple[dict, dict]:
        self.seed, self.options, self.num_steps = seed, options, 0
        return {}, {}

    def call(self, name: str) -> tuple[int, int]:
        assert name == "_max_episode_steps"
        return MAX_STEPS, MAX_STEPS

    def step(self, actions: np.ndarray) -> tuple[Any, Any, Any, Any, dict]:
        self.num_steps += 1
        terminated = np.array([self.num_steps >= 2, False])
        return {}, np.zeros(2), terminated, np.zeros(2, dtype=bool), {}


def test_an_episode_is_written_once_when_it_ends() -> None:
    written: list[tuple[int, list]] = []
    inner = CountingVectorEnv()
    env = LoggedVectorEnv(inner, lambda seed, actions: written.append((seed, actions.tolist())))
    actions = np.empty((2, 1))
    for seeds in ([5, 6], [7, 8]):
        env.reset(seed=seeds, options={"new": True})
        assert (inner.seed, inner.options) == (seeds, {"new": True})
        for step in range(MAX_STEPS):
            actions[:] = [[step], [10 + step]]  # the caller may use its array again
            env.step(actions)
            assert len(written) % 2 == (1 <= step < MAX_STEPS - 1)
    first, second = [[0.0], [1.0]], [[10.0], [11.0], [12.0], [13.0]]
    assert written == [(5, first), (6, second), (7, first), (8, second)]
    assert env.num_envs == 2 and not hasattr(env, "_ensure")
    with pytest.raises(ValueError, match="--seed=null"):
        env.reset()


def evaluate(path: Path, *flags: str) -> int:
    return main(
        [
            "results",
            "actions",
            str(path),
            "--policy.device=cpu",
            f"--output_dir={path.parent / 'eval'}",
            *flags,
        ]
    )


@pytest.mark.parametrize("is_async", ["true", "false"])
def test_executed_actions_lead_to_the_same_result_again(tmp_path: Path, is_async: str) -> None:
    path, results = tmp_path / "actions.jsonl", tmp_path / "results.jsonl"
    env = ["--env.type=bomb", "--env.image_size=32", f"--env.results_path={results}", "--env.fps=5"]
    flags = ["--eval.n_episodes=4", "--eval.batch_size=2", f"--eval.use_async_envs={is_async}", "--seed=5"]
    assert evaluate(path, "--policy.type=bomb_expert", *env, *flags) == 0
    executed = read_executed(path)
    assert (executed.fps, executed.is_seeded) == (5, True)
    steps = {
        f"place, task 0, seed {row.spec.seed}": row.steps for row in read_results(results, EpisodeResult)
    }
    assert {episode: len(actions) for episode, actions in executed.episodes.items()} == steps
    assert len(steps) == 4
    for row in read_results(results, EpisodeResult):  # each line says how smooth these were
        actions_TD = executed.episodes[f"place, task 0, seed {row.spec.seed}"]
        expected = smoothness(actions_TD, np.zeros(len(actions_TD)), exclude=[3])
        assert (row.action_j2, row.action_j3) == pytest.approx((expected.j2.mean, expected.j3.mean))
    spec = EpisodeSpec(6, "place", fps=5)
    replayed = make_env(spec, RenderOptions(image_size=32))
    replayed.reset(seed=6)
    ends = [replayed.step(action)[2] for action in executed.episodes["place, task 0, seed 6"].astype("f4")]
    replayed.close()
    assert ends == [False] * (len(ends) - 1) + [True]


def test_another_environment_and_another_policy(tmp_path: Path) -> None:
    pytest.importorskip("gym_pusht")
    path = tmp_path / "actions.jsonl"
    policy = (
        "--policy.type=act --policy.pretrained_backbone_weights=null --policy.dim_model=32 --policy.n_heads=2"
    )
    policy += " --policy.chunk_size=4 --policy.n_action_steps=4 --policy.push_to_hub=false"
    env = "--env.type=pusht --env.episode_length=6 --eval.use_async_envs=false"
    assert evaluate(path, *policy.split(), *env.split(), "--eval.n_episodes=3", "--eval.batch_size=2") == 0
    executed = read_executed(path)
    assert executed.fps == 10
    # LeRobot runs whole batches, and counts three episodes
    assert list(executed.episodes) == [f"pusht, task 0, seed {seed}" for seed in range(1000, 1003)]
    assert {actions.shape for actions in executed.episodes.values()} == {(6, 2)}


def test_a_file_holds_one_evaluation(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "actions.jsonl"
    path.write_text("old")
    assert evaluate(path) == 1
    assert f"lerobot-bomb results actions: {path} exists already" in capsys.readouterr().err
    assert path.read_text() == "old"
    assert evaluate(tmp_path / "absent" / "actions.jsonl") == 1
    assert "give a file in a folder that exists" in capsys.readouterr().err
    for flags in ([], ["--policy.type=bomb_expert"]):
        with pytest.raises(SystemExit, match="2"):
            main(["results", "actions", *flags])
        assert "the following arguments are required: FILE (" in capsys.readouterr().err


def test_a_failure_of_lerobot_eval_keeps_its_traceback(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = ["--policy.type=bomb_expert", "--env.type=pusht", "--eval.n_episodes=1", "--eval.batch_size=1"]
    assert evaluate(tmp_path / "actions.jsonl", *flags) == 1
    assert "Traceback" in capsys.readouterr().err


def line(**changes: Any) -> str:
    row = {"group": "g", "task_id": 0, "seed": 1, "fps": 10.0, "actions": [[0.0, 1.0], [2.0, 3.0]]}
    return json.dumps(row | changes)


def test_lines_are_read_as_they_were_written(tmp_path: Path) -> None:
    path, actions = tmp_path / "actions.jsonl", np.array([[0.1, 2], [3, 4]], dtype=np.float32)
    for seed in (1, 2):
        append_episode(path, "g", 0, seed, 10, seed * actions)
    executed = read_executed(path)
    assert list(executed.episodes) == ["g, task 0, seed 1", "g, task 0, seed 2"]
    np.testing.assert_array_equal(executed.episodes["g, task 0, seed 2"], 2 * actions.astype(np.float64))
    assert (executed.name, executed.fps, executed.num_dims) == (str(path), 10, 2)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([], "no episode"),
        ([line(), '{"group": "g", "ta'], ":2: not the actions of an episode"),
        (["[1, 2]"], ":1: not the actions of an episode"),
        (
            [json.dumps({"seed": 1})],
            ":1: not the actions of an episode, as `lerobot-bomb results actions` writes them$",
        ),
        ([line(actions=[[1, 2], [3]])], ":1: not the actions of an episode"),
        ([line(actions=[])], r":1: actions have the shape \(0,\), not \(T, D\)"),
        ([line(), line()], ":2: g, task 0, seed 1 was there already"),
        ([line(), line(seed=2, fps=20)], r"different rates, \[10.0, 20.0\]"),
        ([line(), line(seed=2, actions=[[1]])], "episodes differ in the number of action dims"),
        ([line(actions=[[float("nan"), 1]])], "episode g, task 0, seed 1 has actions that are not finite"),
        ([line(fps=0)], "fps=0.0 must be positive"),
    ],
)
def test_files_that_hold_something_else(tmp_path: Path, lines: list[str], message: str) -> None:
    path = tmp_path / "actions.jsonl"
    path.write_text("\n".join(lines))
    with pytest.raises(ValueError, match=message):
        read_executed(path)
