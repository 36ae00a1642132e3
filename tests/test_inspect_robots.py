"""Inspect Robots runs BOMB with our checkpoints as lerobot-eval does, and says what does not fit."""

import json
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("inspect_robots", reason="the extra inspect is not installed")

from inspect_robots import eval as evaluate
from inspect_robots.conformance import assert_embodiment_conformant
from inspect_robots.errors import CompatibilityError, ConfigError, EmbodimentFault
from inspect_robots.registry import resolve
from inspect_robots.scene import Scene
from inspect_robots.types import Action

from lerobot_bomb.bomb.suites import OWN_SUITES
from lerobot_bomb.checkpoints.acting import acting
from lerobot_bomb.inspect_robots import embodiment as embodiment_module
from lerobot_bomb.inspect_robots.embodiment import BombEmbodiment
from lerobot_bomb.inspect_robots.policy import CheckpointPolicy
from lerobot_bomb.inspect_robots.tasks import make_task
from lerobot_bomb.results.origin import PolicyIdentity
from lerobot_bomb.results.record import MEASURED

SMALL = {"image_size": 64}
CONDITIONS = "none,language:5"  # the checkpoint masters the first, and hardly the second
LISTED = "from inspect_robots.registry import registered as of; import sys; print(*of('policy'), *of('task'))"


@pytest.fixture(scope="module")
def policy() -> CheckpointPolicy:
    return CheckpointPolicy("bomb:fdvla", device="cpu")


def records_of(path: Path) -> list[dict[str, Any]]:
    """Records but for the evaluation, which nobody tells the environment, and for times."""
    records = map(json.loads, path.read_text().splitlines())
    return [record | {"evaluation": None} | dict.fromkeys(MEASURED) for record in records]


@pytest.mark.long
def test_records_are_those_of_lerobot_eval(stock_cli: Callable[..., None], tmp_path: Path) -> None:
    ours, lerobot = tmp_path / "inspect.jsonl", tmp_path / "lerobot.jsonl"
    flags = ["--policy=lerobot_checkpoint", "-P", "checkpoint=bomb:fdvla", "-P", "device=cpu"]
    flags += ["--task=bomb/place", "-T", "episodes=2", "-T", f"perturbations={CONDITIONS}"]
    flags += ["--embodiment=bomb", "-E", f"results_path={ours}", "--no-prompt", f"--log-dir={tmp_path}"]
    command = [sys.executable, "-m", "inspect_robots.cli", "run", *flags]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "2 succeeded" in done.stdout
    stock_cli(
        "lerobot-eval",
        "--policy.path=bomb:fdvla",
        "--policy.device=cpu",
        "--env.type=bomb",
        f"--env.perturbations={json.dumps(CONDITIONS.split(','))}",
        f"--env.results_path={lerobot}",
        "--eval.n_episodes=2",
        "--eval.batch_size=1",
        "--eval.use_async_envs=false",
        f"--output_dir={tmp_path / 'eval'}",
    )
    assert records_of(ours) == records_of(lerobot)


def test_a_list_of_what_is_registered_loads_no_model() -> None:
    code = f"{LISTED}; assert not {{'torch', 'lerobot', 'mujoco'}} & sys.modules.keys()"
    words = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert {"lerobot_checkpoint", *(f"bomb/{suite}" for suite in OWN_SUITES)} <= set(words.split())


@pytest.mark.parametrize("control_mode", ["relative", "absolute"])
def test_the_embodiment_declares_what_guardrails_and_agents_need(control_mode: str) -> None:
    info = BombEmbodiment(control_mode=control_mode, **SMALL).info
    assert_embodiment_conformant(info)
    assert info.docs is not None and "metres" in info.docs


def test_tasks_have_a_scene_for_each_seed_and_condition() -> None:
    task = make_task("spatial", "none,camera:3", episodes=2, seed=5, task_id=1)
    names = [f"spatial.{condition}-{seed}" for condition in ("none", "camera-3") for seed in (5, 6)]
    assert [scene.id for scene in task.scenes] == names
    (first, *_) = task.scenes
    embodiment = BombEmbodiment(ignore_checkpoint=True, **SMALL)  # another test's policy may still be held
    assert embodiment.reset(first).instruction == first.instruction
    embodiment.close()


def test_the_environment_ends_the_episode_when_the_task_does() -> None:
    embodiment, task = BombEmbodiment(**SMALL), make_task("place", episodes=1)
    embodiment.reset(task.scenes[0])
    max_steps = task.resolve_envelope(embodiment.info.control_hz).max_steps
    results = [embodiment.step(Action(np.array([0.0, 0.0, 0.0, 1.0]))) for _ in range(max_steps)]
    embodiment.close()
    assert [result.truncated for result in results] == [False] * (max_steps - 1) + [True]


def test_records_name_the_policy_that_acts_now(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    embodiment = BombEmbodiment(results_path=str(tmp_path / "r.jsonl"), **SMALL)
    (scene,) = make_task("place", episodes=1).scenes
    for number, name in enumerate(("act", "fdvla")):
        known = [{"policy": PolicyIdentity(name)}]
        monkeypatch.setattr(embodiment_module, "policy_of_results", lambda *_, known=known: known)
        embodiment.reset(scene, seed=number)
        while not embodiment.step(Action(np.array([0.0, 0.0, 0.0, 1.0]))).truncated:
            pass
    embodiment.close()
    assert [each["policy"]["type"] for each in records_of(tmp_path / "r.jsonl")] == ["act", "fdvla"]


def test_every_policy_that_acts_is_checked(policy: CheckpointPolicy) -> None:
    config: Any = policy._policy.config
    elsewhere = replace(config, environment=replace(config.environment, task="spatial"))
    embodiment = BombEmbodiment(**SMALL)
    (scene,) = make_task("place", episodes=1).scenes
    with acting(config):
        embodiment.reset(scene)
    with acting(elsewhere), pytest.raises(EmbodimentFault, match="trained for an environment with task=spat"):
        embodiment.reset(scene)
    embodiment.close()


def test_a_second_epoch_of_records_is_refused(tmp_path: Path) -> None:
    (scene,) = make_task("place", episodes=1).scenes
    for flags in ({}, {"results_path": str(tmp_path / "r.jsonl")}):
        embodiment = BombEmbodiment(**flags, **SMALL)
        for seed in (1, 1):  # a trial that is tried again is the same epoch
            embodiment.reset(scene, seed=seed)
        if flags:
            with pytest.raises(EmbodimentFault, match="second epoch"):
                embodiment.reset(scene, seed=2)
        else:
            embodiment.reset(scene, seed=2)
        embodiment.close()


def test_images_have_the_size_that_the_acting_checkpoint_reads(policy: CheckpointPolicy) -> None:
    with acting(policy._policy.config):
        cameras = BombEmbodiment().info.observation_space.cameras
    assert {(camera.height, camera.width) for camera in cameras} == {(64, 64)}


@pytest.mark.parametrize(
    ("kind", "name", "flags", "message"),
    [
        ("task", "bomb/place", {"perturbations": "camra:3"}, "'camra' is not an axis"),
        ("task", "bomb/place", {"episodes": 0}, "episodes=0 must be at least 1"),
        ("task", "bomb/goal", {"task_id": 99}, "--env.task_ids has 99"),
        ("embodiment", "bomb", {"image_sise": 64}, "image_sise"),
        ("embodiment", "bomb", {"task": "place"}, "--task bomb/SUITE"),
        ("embodiment", "bomb", {"depth": True}, "has no depth"),
        ("policy", "lerobot_checkpoint", {"checkpoint": "nowhere"}, "there is no such folder"),
        (
            "policy",
            "lerobot_checkpoint",
            {"checkpoint": "bomb:fdvla", "cameras": "a"},
            "cameras=a: name them",
        ),
    ],
)
def test_a_wrong_flag_is_named(kind: str, name: str, flags: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)):
        resolve(kind, name, **flags)


def test_scenes_of_others_and_suites_that_were_not_trained_are_refused(
    policy: CheckpointPolicy, tmp_path: Path
) -> None:
    embodiment = BombEmbodiment(**SMALL)
    with pytest.raises(EmbodimentFault, match="none of BOMB"):
        embodiment.reset(Scene("theirs", "Stack the cups."))
    trained_for = "trained for an environment with task=place"
    with acting(policy._policy.config), pytest.raises(EmbodimentFault, match=trained_for):
        embodiment.reset(make_task("spatial", episodes=1).scenes[0])
    with pytest.raises(CompatibilityError, match="control_mode"):
        absolute = BombEmbodiment(control_mode="absolute", **SMALL)
        evaluate(make_task("place", episodes=1), policy, absolute, log_dir=str(tmp_path))
