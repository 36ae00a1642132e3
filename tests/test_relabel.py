"""`record --relabel`: a policy acts, the expert says what it would have done."""

from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fdvla_cases import make_policy, stats
from lerobot.datasets import LeRobotDataset
from lerobot.policies.factory import make_pre_post_processors

from lerobot_bomb.bomb.environment import Environment
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.expert import expert_action
from lerobot_bomb.bomb.observation import RenderOptions
from lerobot_bomb.bomb.pointing import colors_on_spots
from lerobot_bomb.bomb.privileged_state import PrivilegedState
from lerobot_bomb.commands.main import main
from lerobot_bomb.data.recorded_blocks import BehaviorPolicy, EpisodeSource
from lerobot_bomb.data.recording import Recording
from lerobot_bomb.envs.rollout import make_env

HERE = Environment("scara", "relative", 10, 64, ("workspace", "wrist"), "1.0", "place")


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An untrained policy, which never reaches a stone."""
    folder = tmp_path_factory.mktemp("checkpoint")
    policy = make_policy(chunk_size=1, n_action_steps=1, num_inference_steps=1)
    policy.config.environment = HERE
    policy.save_pretrained(folder)
    for processor in make_pre_post_processors(policy.config, dataset_stats=stats()):
        processor.save_pretrained(folder)
    return folder


def flags(checkpoint: Path, root: Path, **others: Any) -> list[str]:
    given = {"repo_id": "test/own", "root": root, "episodes": 1, "seed": 3, "image_size": 64} | others
    named = [f"--{name}={value}" for name, value in given.items()]
    return ["record", *named, "--images", "--relabel", f"--policy.path={checkpoint}"]


def test_what_the_policy_sees_gets_the_experts_actions(checkpoint: Path, tmp_path: Path) -> None:
    assert main([*flags(checkpoint, tmp_path / "own"), "--pointing"]) == 0
    dataset: Any = LeRobotDataset("test/own", root=tmp_path / "own")
    assert dataset.num_episodes == 1 and len(dataset) == 100  # it failed, and is kept
    env = make_env(EpisodeSpec(3), RenderOptions(64))
    observation, _ = env.reset(seed=3)
    first: Any = dataset[0]
    state = PrivilegedState.from_vector(observation["environment_state"])
    np.testing.assert_array_equal(first["action"], expert_action(state))
    np.testing.assert_array_equal(first["observation.pointing.spots"], colors_on_spots(state))
    states = np.stack([np.asarray(dataset[i]["observation.state"]) for i in (0, 40, 99)])
    assert abs(np.diff(states[:, :3], axis=0)).max() > 0.01  # it moved, and not as the expert
    env.close()


def test_episodes_begin_with_their_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lerobot_bomb.data.rollout_pool._Worker.rollout", lambda _, spec: spec)
    begun: list[int] = []
    source = EpisodeSource(behavior=BehaviorPolicy(begun.append, lambda *_: np.zeros(4)))
    pool = source.rollouts(Recording("test/own", episodes=10, relabel="weights"), num_tried=6)
    for _ in range(2):  # blocks
        assert len(list(islice(pool, 2))) == 2
    assert begun == [6, 7, 8, 9]


def test_a_policy_of_another_environment_is_refused(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(flags(checkpoint, tmp_path / "own", task="spatial")) == 1
    error = capsys.readouterr().err
    assert "was trained for an environment with task=place; this one has task=spatial" in error
    assert "record with --env.task=place, or train one for this" in error
    assert not (tmp_path / "own").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--relabel"], "--relabel and --policy.path=FOLDER come together"),
        (["--policy.path=bomb:fdvla"], "--relabel and --policy.path=FOLDER come together"),
        (["--relabel", "--policy.path=nowhere"], "--policy.path=nowhere: there is no such folder"),
        (["--relabel", "--policy.path=bomb:fdvla", "--workers=2"], "--workers=2: with --relabel"),
    ],
)
def test_wrong_flags_are_named(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["record", "--repo_id=test/x", "--episodes=2", *arguments]) == 1
    assert message in capsys.readouterr().err
