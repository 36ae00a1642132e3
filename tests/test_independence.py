"""An episode depends on seed and spec alone: not on its process, worker or batch, nor on earlier episodes."""

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.expert import expert_action
from lerobot_bomb.bomb.observation import RenderOptions
from lerobot_bomb.bomb.suites import SUITES
from lerobot_bomb.envs.vector import NEW_ROLLOUT_OPTION, LazyVectorEnv
from lerobot_bomb.results.bomb import EpisodeResult
from lerobot_bomb.results.groups import read_results
from lerobot_env_bomb.bomb.env import BombEnv

SMALL = RenderOptions(image_size=32)
SEEDS = (10, 11)
# of a network's actions: a matrix product of another batch size may round otherwise; bins are 100 times wider
BINS_TOLERANCE = 1e-4
# where actions are no bins, the next image shows what was rounded otherwise
TOLERANCES = {"fdvla": 2e-3}
SPECS = (
    EpisodeSpec(0, perturbations="all:1-5"),
    pytest.param(EpisodeSpec(0), marks=pytest.mark.long),
    *(
        pytest.param(EpisodeSpec(0, suite, perturbations="all:1-5"), marks=pytest.mark.long)
        for suite in SUITES
        if suite != "place"
    ),
)

type Observations = list[dict[str, np.ndarray]]
type Run = Callable[..., None]


# Observations


def make_one(spec: EpisodeSpec) -> BombEnv:
    return BombEnv(spec, SMALL)


@pytest.fixture(scope="module", params=SPECS, ids=lambda spec: f"{spec.suite}-{spec.perturbations}")
def spec(request: pytest.FixtureRequest) -> EpisodeSpec:
    return request.param


def flat(observation: dict[str, Any], instruction: str | tuple[str, ...]) -> dict[str, np.ndarray]:
    """A copy of every key, and what is said."""
    others = {key: observation[key] for key in ("agent_pos", "environment_state")}
    assert {"pixels", *others} == set(observation)
    arrays = {key: value.copy() for key, value in (others | observation["pixels"]).items()}
    return arrays | {"instruction": np.array(instruction)}


def run_expert(env: BombEnv, seed: int) -> tuple[np.ndarray, Observations]:
    """Actions (T, 4) and the T + 1 observations of a whole episode."""
    observation, _ = env.reset(seed=seed)
    observations, actions, ended = [flat(observation, env.task_description)], [], False
    while not ended:
        actions.append(expert_action(env.privileged_state()))
        observation, _, terminated, truncated, _ = env.step(actions[-1])
        observations.append(flat(observation, env.task_description))
        ended = terminated or truncated
    return np.stack(actions), observations


def run_together(envs: LazyVectorEnv, actions: list[np.ndarray]) -> list[Observations]:
    """The observations of one episode per env, each as long as its actions."""
    num_steps = max(map(len, actions))
    actions_TED = np.stack(
        [np.pad(actions_TD, ((0, num_steps - len(actions_TD)), (0, 0))) for actions_TD in actions], axis=1
    )
    observation, _ = envs.reset(seed=list(SEEDS[: len(actions)]), options={NEW_ROLLOUT_OPTION: True})
    steps = [flat(observation, envs.call("task_description"))]
    for actions_ED in actions_TED:
        observation = envs.step(actions_ED)[0]
        steps.append(flat(observation, envs.call("task_description")))
    return [
        [{key: values[i] for key, values in step.items()} for step in steps[: len(actions_TD) + 1]]
        for i, actions_TD in enumerate(actions)
    ]


def assert_same(observations: Observations, expected: Observations) -> None:
    for step, (one, other) in enumerate(zip(observations, expected, strict=True)):
        assert one.keys() == other.keys()
        for key in other:
            np.testing.assert_array_equal(one[key], other[key], err_msg=f"{key} in step {step}")


def digest(observations: Observations) -> str:
    """Hash every bit of every key."""
    parts = [step[key].tobytes() for step in observations for key in sorted(step)]
    return hashlib.sha256(b"".join(parts)).hexdigest()


@pytest.fixture(scope="module")
def episodes(spec: EpisodeSpec) -> list[tuple[np.ndarray, Observations]]:
    """The expert's episodes of SEEDS, each the first of its env."""
    episodes_run = []
    for seed in SEEDS:
        env = make_one(spec)
        episodes_run.append(run_expert(env, seed))
        env.close()
    assert len(episodes_run[0][0]) != len(episodes_run[1][0])
    return episodes_run


@pytest.fixture
def used_env(spec: EpisodeSpec) -> Iterator[BombEnv]:
    """An env in which an episode was broken off with a stone in the air, and one with the arm astray."""
    env = make_one(spec)
    env.reset(seed=3)
    for _ in range(15):
        env.step(expert_action(env.privileged_state()))
    env.reset(seed=4)
    for _ in range(5):
        env.step(np.array([-0.3, 0.1, -0.5, -1.0]))
    yield env
    env.close()


def test_earlier_episodes_leave_nothing_behind(
    used_env: BombEnv, episodes: list[tuple[np.ndarray, Observations]]
) -> None:
    for seed, (actions, expected) in zip((*SEEDS, *SEEDS), (*episodes, *episodes), strict=True):
        observation, _ = used_env.reset(seed=seed)
        observations = [flat(observation, used_env.task_description)]
        for action in actions:
            observation = used_env.step(action)[0]
            observations.append(flat(observation, used_env.task_description))
        assert_same(observations, expected)


def test_a_fresh_process_gives_the_same_bits(
    spec: EpisodeSpec, episodes: list[tuple[np.ndarray, Observations]]
) -> None:
    script = (
        "from test_independence import make_one, EpisodeSpec, SEEDS, digest, run_expert\n"
        f"env = make_one({spec!r})\n"
        "print([digest(run_expert(env, seed)[1]) for seed in reversed(SEEDS)])\n"
    )
    run = subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        cwd=Path(__file__).parent,
        env=os.environ | {"PYTHONHASHSEED": "1"},  # another order of sets than here
    )
    expected = [digest(observations) for _, observations in reversed(episodes)]
    assert run.stdout.strip() == str(expected), run.stderr


@pytest.mark.parametrize(
    ("num_envs", "use_async", "context"),
    [(1, False, "forkserver"), (2, False, "forkserver"), (2, True, "forkserver"), (2, True, "spawn")],
)
def test_vector_envs_give_the_same_bits(
    spec: EpisodeSpec,
    episodes: list[tuple[np.ndarray, Observations]],
    num_envs: int,
    use_async: bool,
    context: str,
) -> None:
    envs = LazyVectorEnv([partial(make_one, spec)] * num_envs, use_async=use_async, context=context)
    try:
        episodes_run = run_together(envs, [actions for actions, _ in episodes[:num_envs]])
    finally:
        envs.close()
    for observations, (_, expected) in zip(episodes_run, episodes, strict=False):
        assert_same(observations, expected)


# Evaluation


@dataclass(frozen=True)
class Outcome:
    """Outcome of one seed in lerobot-eval: its record, and the actions (T, 4) that were executed."""

    record: EpisodeResult
    actions: np.ndarray


def evaluate(
    run: Run, folder: Path, flags: list[str], batch_size: int, use_async: bool, num_episodes: int = 4
) -> dict[int, Outcome]:
    """lerobot-eval on the seeds from 5 on; the last batch may run more than asked."""
    from lerobot.scripts import lerobot_eval

    rollout = lerobot_eval.rollout
    actions: dict[int, np.ndarray] = {}

    def note(*, seeds: list[int], render_callback: object, **others: Any) -> dict:
        data = rollout(seeds=seeds, **others)  # without an image of every step
        for i, seed in enumerate(seeds):
            num_steps = int(data["done"][i].int().argmax()) + 1
            actions[seed] = data["action"][i, :num_steps].numpy()
        return data

    folder.mkdir()
    own = f"--env.type=bomb --env.image_size=64 --env.results_path={folder / 'results.jsonl'} --seed=5"
    own += f" --policy.device=cpu --output_dir={folder / 'eval'} --eval.n_episodes={num_episodes}"
    own += f" --eval.batch_size={batch_size} --eval.use_async_envs={json.dumps(use_async)}"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lerobot_eval, "rollout", note)
        run("lerobot-eval", *own.split(), *flags)
    records = read_results(folder / "results.jsonl", EpisodeResult)
    by_seed = {each.spec.seed: replace(each, inference=None) for each in records}
    assert by_seed.keys() == set(range(5, 5 + num_episodes)) <= actions.keys()
    return {seed: Outcome(record, actions[seed]) for seed, record in by_seed.items()}


def assert_independent(
    run: Run, folder: Path, flags: list[str], tolerance: float = 0.0
) -> dict[int, Outcome]:
    """Evaluate one by one, in batches and in worker processes; the outcomes must be the same."""
    alone = evaluate(run, folder / "alone", flags, batch_size=1, use_async=False)
    assert len({outcome.actions.tobytes() for outcome in alone.values()}) == 4
    for batch_size, use_async in ((3, False), (2, True)):
        together = evaluate(run, folder / f"in_{batch_size}", flags, batch_size, use_async)
        for seed, expected in alone.items():
            assert_alike(together[seed], expected, tolerance, f"seed {seed} in batches of {batch_size}")
    return alone


def assert_alike(actual: Outcome, expected: Outcome, tolerance: float, message: str) -> None:
    assert len(actual.actions) == len(expected.actions), message
    np.testing.assert_allclose(actual.actions, expected.actions, rtol=0, atol=tolerance, err_msg=message)
    found = actual.record.as_json()
    for key, value in expected.record.as_json().items():
        if key == "policy":
            in_batch = {name: found[key][name] for name in ("batch_size", "batch_row")}
            value = value | in_batch
        # floats are millimetres; 1000 times the tolerance of an action, whose unit is 40 mm
        same = pytest.approx(value, rel=0, abs=1e3 * tolerance) if isinstance(value, float) else value
        assert found[key] == same, f"{key}: {message}"


# random actions use up an episode's 10 s
@pytest.mark.parametrize(("scripted", "fps"), [("bomb_expert", 5), ("bomb_random", 2)])
def test_scripted_results_do_not_depend_on_batch_or_workers(
    stock_cli: Run, tmp_path: Path, scripted: str, fps: int
) -> None:
    outcomes = assert_independent(stock_cli, tmp_path, [f"--policy.type={scripted}", f"--env.fps={fps}"])
    assert all(outcome.record.is_success == (scripted == "bomb_expert") for outcome in outcomes.values())
    assert len({outcome.record.placement_error_mm for outcome in outcomes.values()}) == 4


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Any:
    from parity_routes import Recorded

    return Recorded.make(tmp_path_factory.mktemp("recorded") / "dataset", images=True)


@pytest.fixture
def checkpoint(recorded: Any, tmp_path: Path, policy_type: str) -> Path:
    """Train without an update: every input tells in the actions of random weights."""
    from lerobot.utils.import_utils import register_third_party_plugins
    from parity_routes import cli_flags, run_train
    from recipes import read_recipe

    register_third_party_plugins()
    # the whole recipe: how far what was rounded otherwise carries in an episode depends on the network
    flags = cli_flags(policy_type, read_recipe("overfit", policy_type)["policy"], use_state=True)
    run_train(recorded, tmp_path / "train", flags, finish=None)
    return tmp_path / "train" / "checkpoints" / "last" / "pretrained_model"


def tolerance_of(checkpoint: Path) -> float:
    policy_type = json.loads((checkpoint / "config.json").read_text())["type"]
    return TOLERANCES.get(policy_type, BINS_TOLERANCE)


@pytest.mark.one_type
def test_a_networks_results_do_not_depend_on_batch_or_workers(
    stock_cli: Run, tmp_path: Path, checkpoint: Path
) -> None:
    # episodes of 20 steps end in the middle of a chunk
    flags = [f"--policy.path={checkpoint}", "--env.fps=2", "--env.ignore_checkpoint=true"]
    flags.append("--policy.n_action_steps=3")
    outcomes = assert_independent(stock_cli, tmp_path, flags, tolerance_of(checkpoint))
    assert len({len(outcome.record.instruction) for outcome in outcomes.values()}) > 1  # rows are padded
    assert min(len(np.unique(outcome.actions, axis=0)) for outcome in outcomes.values()) > 3


@pytest.mark.long
def test_a_networks_results_do_not_depend_on_larger_batches(
    stock_cli: Run, tmp_path: Path, checkpoint: Path
) -> None:
    options = {"flags": [f"--policy.path={checkpoint}"], "use_async": False, "num_episodes": 16}
    alone = evaluate(stock_cli, tmp_path / "alone", batch_size=1, **options)
    tolerance = tolerance_of(checkpoint)
    for batch_size in (5, 16):
        together = evaluate(stock_cli, tmp_path / f"in_{batch_size}", batch_size=batch_size, **options)
        for seed, expected in alone.items():
            assert_alike(together[seed], expected, tolerance, f"seed {seed} in {batch_size}")
