"""`lerobot-bomb push --env.type=...`: an environment on the Hub, which stock `make_env` builds."""

from pathlib import Path

import pytest
from huggingface_hub import HfApi

from hub import runner
from hub.server import TOKEN, LoopbackHub
from lerobot_bomb.commands.main import main
from lerobot_bomb.hub.environment import ENV_FILE

REPO_ID = "me/goal"
FLAGS = [
    "--env.type=bomb",
    "--env.task=goal",
    '--env.perturbations=["none","camera:3"]',
    "--env.task_ids=[2]",
    "--env.image_size=64",
]
# a process that has not loaded the plugin builds it with LeRobot's own function, twice in two ways
PLAYS = f"""
import sys
from lerobot.envs.factory import make_env
assert "lerobot_policy_bomb" not in sys.modules
envs = make_env("{REPO_ID}", n_envs=2, trust_remote_code=True)
assert list(envs) == ["goal.none", "goal.camera-3"] and [*envs["goal.none"]] == [2], envs
env = envs["goal.camera-3"][2]
observation, _ = env.reset(seed=[1000, 1001])
assert observation["pixels"]["wrist"].shape == (2, 64, 64, 3)
from lerobot_env_bomb.bomb.configuration_bomb import BombEnvConfig
config = BombEnvConfig(task="goal", perturbations=["camera:3"], task_ids=[2], image_size=64)
same = config.create_envs(2)["goal.camera-3"][2].reset(seed=[1000, 1001])[0]
assert (observation["pixels"]["wrist"] == same["pixels"]["wrist"]).all()
print("same pixels")
"""


def push(*flags: str) -> int:
    return main(["push", f"--repo_id={REPO_ID}", *flags])


def test_stock_make_env_builds_what_was_pushed(
    online: LoopbackHub, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert push(*FLAGS, "--dry_run") == 0
    foreseen = capsys.readouterr().out
    assert online.requests == []
    assert push(*FLAGS) == 0 and push(*FLAGS) == 0  # again: over itself
    files = online.model(REPO_ID).files()
    assert foreseen == f"{files['README.md'].decode()}\n{files[ENV_FILE].decode()}\n"
    assert """'--env.perturbations=["none", "camera:3"]'""" in foreseen  # as a shell takes it
    ended = runner.run([["python", PLAYS]], online.endpoint, tmp_path / "home", TOKEN)
    assert ended.code == 0 and "same pixels" in ended.text, ended.text


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ([], "give a folder, or an environment"),
        (["--env.task=goal"], "--env.type is missing"),
        (["--env.type=bmob"], "'bmob' is unknown"),
        (["--env.type=pusht"], "no environment of lerobot_bomb"),
        (["--env.type=bomb", "--env.tsk=goal"], "`tsk`"),
        (["--env.type=bomb", "--env.results_path=x.jsonl"], "a path of this machine"),
        (["--env.type=bomb", "--policy.path=x"], "--policy.path is no flag of an environment"),
        (["--env.type=bomb", "--results", "x.jsonl"], "--results is of a checkpoint"),
        ([".", "--env.type=bomb"], "--env.type=bomb is of an environment"),
    ],
)
def test_wrong_flags_publish_nothing(
    flags: list[str], message: str, online: LoopbackHub, capsys: pytest.CaptureFixture[str]
) -> None:
    assert push(*flags) == 1
    assert message in capsys.readouterr().err
    assert online.requests == []


def test_a_repository_of_something_else_is_left_alone(
    online: LoopbackHub, capsys: pytest.CaptureFixture[str]
) -> None:
    HfApi().create_repo(REPO_ID)
    online.model(REPO_ID).commit({"config.json": b"{}"}, "a checkpoint")
    assert push("--env.type=bomb") == 1
    assert "holds config.json, so it is no environment's" in capsys.readouterr().err
    assert online.model(REPO_ID).files() == {"config.json": b"{}"}
