"""vla-eval runs BOMB with our checkpoints as lerobot-eval does, and says what does not fit."""

import asyncio
import importlib
import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import get_policy_class, make_policy_config, make_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_STATE
from lerobot.utils.import_utils import register_third_party_plugins
from libero_cases import SUITE

pytest.importorskip("vla_eval", reason="the extra vla-eval is not installed")

from vla_eval import api
from vla_eval.model_servers import serve
from vla_eval.model_servers.base import SessionContext

from lerobot_bomb.bomb.suites import SUITES
from lerobot_bomb.checkpoints.folder import write_checkpoint
from lerobot_bomb.harness import __main__ as command
from lerobot_bomb.harness.benchmark import BombBenchmark
from lerobot_bomb.harness.checkpoint_server import CheckpointServer
from lerobot_bomb.libero.assets import Libero, prepare_libero
from lerobot_bomb.results.record import MEASURED

CONFIGS = Path(__file__).parents[1] / "configs" / "vla_eval"
CONDITIONS = ["none", "language:5"]  # the checkpoint masters the first, and hardly the second
SEEDS = [1000, 1001]
SEEN_IN_LIBERO = {
    "observation.images.image": (3, 256, 256),
    "observation.images.image2": (3, 256, 256),
    OBS_STATE: (8,),
    ACTION: (7,),
}
SMALL = {"image_size": 64}


@pytest.fixture(scope="module")
def server() -> CheckpointServer:
    return CheckpointServer("bomb:fdvla", device="cpu")


def run(server: CheckpointServer, output: Path, num_episodes: int, **params: Any) -> list[dict[str, Any]]:
    """Episodes of configs/vla_eval/bomb.yaml with other parameters, by a server on loopback."""
    overrides = {"episodes_per_task": num_episodes, "params": params}
    config = CONFIGS / "bomb.yaml"
    (result,) = api.evaluate(server, config, output_dir=output, benchmark_overrides=overrides)
    return [episode for task in result["tasks"] for episode in task["episodes"]]


def lines_of(path: Path) -> list[dict[str, Any]]:
    """Lines of results but for policy and evaluation, which the harness neither names nor times."""
    lines = map(json.loads, path.read_text().splitlines())
    return [line | {"policy": None, "evaluation": None} | dict.fromkeys(MEASURED) for line in lines]


@pytest.mark.long
def test_the_harness_runs_the_episodes_of_lerobot_eval(
    server: CheckpointServer, stock_cli: Callable[..., None], tmp_path: Path
) -> None:
    harness, lerobot = tmp_path / "harness.jsonl", tmp_path / "lerobot.jsonl"
    episodes = run(server, tmp_path, len(SEEDS), perturbations=CONDITIONS, results_path=str(harness))
    stock_cli(
        "lerobot-eval",
        "--policy.path=bomb:fdvla",
        "--policy.device=cpu",
        "--env.type=bomb",
        "--env.image_size=64",
        f"--env.perturbations={json.dumps(CONDITIONS)}",
        f"--env.results_path={lerobot}",
        f"--eval.n_episodes={len(SEEDS)}",
        "--eval.batch_size=1",
        "--eval.use_async_envs=false",
        f"--output_dir={tmp_path / 'eval'}",
    )
    lines = lines_of(lerobot)
    assert [line["spec"]["seed"] for line in lines] == SEEDS * len(CONDITIONS)
    assert {line["is_success"] for line in lines} == {True, False}
    assert lines_of(harness) == lines
    assert {
        (episode["name"], episode["metrics"]["seed"], episode["metrics"]["success"], episode["steps"])
        for episode in episodes
    } == {
        (
            f"place.{line['spec']['perturbations'].replace(':', '-')}",
            line["spec"]["seed"],
            line["is_success"],
            line["steps"],
        )
        for line in lines
    }


def test_a_checkpoint_for_another_environment_is_refused(server: CheckpointServer, tmp_path: Path) -> None:
    params = {"perturbations": None, "results_path": None, "control_mode": "absolute"}
    (episode,) = run(server, tmp_path, 1, **params)
    assert episode["failure_reason"] == "model_act"
    assert "control_mode=relative; this one has control_mode=absolute" in episode["failure_detail"]


def test_tasks_are_groups_of_lerobot_eval_and_numbered_tasks() -> None:
    conditions = ["none", "camera:3"]
    benchmark = BombBenchmark(task="all", perturbations=conditions, **SMALL)
    names = [task["name"] for task in benchmark.get_tasks()]
    assert names == [f"{suite}.{condition}" for suite in SUITES for condition in ("none", "camera-3")]
    numbered = BombBenchmark(task_ids=[3, 12], **SMALL)
    assert [task["name"] for task in numbered.get_tasks()] == ["place.3", "place.12"]


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ({"task": "chess"}, "--env.task='chess'"),
        ({"perturbations": ["camera:9"]}, "the levels of camera must lie in 0..5"),
        ({"image_sise": 64}, "image_sise"),
        ({"image_size": "small"}, "image_size"),
        ({"depth": True}, "has no depth"),
        ({"results_path": f"{__file__}/results.jsonl"}, "results.jsonl cannot be written"),
    ],
)
def test_a_wrong_flag_is_named(flags: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        BombBenchmark(**flags)


def started(argv: list[str], monkeypatch: pytest.MonkeyPatch) -> tuple[CheckpointServer, str, int]:
    """Return what `python -m lerobot_bomb.harness` would serve, and where."""
    served: list[Any] = []
    monkeypatch.setattr(serve, "serve", lambda server, host, port: served.extend((server, host, port)))
    monkeypatch.setattr(sys, "argv", ["harness", *argv])
    command.run_checkpoint_server()
    model_server, host, port = served
    return model_server, host, port


def test_a_server_is_started_by_a_file_and_flags_on_this_machine_only(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    file = f"--config={CONFIGS / 'serve_bomb_fdvla.yaml'}"
    flags = ["--args.policy.num_inference_steps=3", "--port=8001"]
    model_server, host, port = started([file, *flags], monkeypatch)
    assert (host, port) == ("127.0.0.1", 8001)
    config: Any = model_server._policy.config
    assert (config.type, config.device, config.num_inference_steps) == ("fdvla", "cpu", 3)


@pytest.mark.parametrize(
    ("checkpoint", "message"),
    [("nowhere", "nowhere: there is no such folder"), ("bomb:chess", "no checkpoint 'chess' comes with")],
)
def test_a_missing_checkpoint_ends_it_in_one_line(
    checkpoint: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(SystemExit) as ended:
        started([f"--args.checkpoint={checkpoint}"], monkeypatch)
    assert message in str(ended.value.code) and "\n" not in str(ended.value.code)


def write_libero_policy(folder: Path) -> None:
    """Write an untrained policy of what LIBERO's demonstrations show."""
    register_third_party_plugins()
    shapes = {key: shape for key, shape in SEEN_IN_LIBERO.items() if key != ACTION}
    kinds = {key: FeatureType.STATE if key == OBS_STATE else FeatureType.VISUAL for key in shapes}
    config: Any = make_policy_config(
        "fdvla",
        device="cpu",
        vlm_model_name="nano",
        head_dim=32,
        dualmod_dim=16,
        dtype="float32",
        input_features={key: PolicyFeature(kinds[key], shape) for key, shape in shapes.items()},
        output_features={ACTION: PolicyFeature(FeatureType.ACTION, SEEN_IN_LIBERO[ACTION])},
    )
    stats = {
        key: {"mean": torch.zeros(shape), "std": torch.ones(shape)}
        for key, shape in SEEN_IN_LIBERO.items()
        if key in (OBS_STATE, ACTION)
    }
    processors = make_pre_post_processors(config, dataset_stats=stats)
    write_checkpoint(folder, get_policy_class("fdvla")(config), processors)


@pytest.mark.long
def test_its_libero_runs_with_the_file_for_it(
    libero_with_assets: Libero, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepare_libero([SUITE])
    monkeypatch.setattr(torch, "load", torch.load)  # which it replaces for good
    write_libero_policy(tmp_path / "checkpoint")
    args = yaml.safe_load((CONFIGS / "serve_libero.yaml").read_text())["args"]
    server = CheckpointServer(**args | {"checkpoint": str(tmp_path / "checkpoint")})
    libero = {
        "benchmark": "vla_eval.benchmarks.libero.benchmark:LIBEROBenchmark",
        "max_steps": 3,
        "max_tasks": 1,
        "params": {"suite": SUITE, "seed": 7},
    }
    (result,) = api.evaluate(server, {"benchmarks": [libero]}, output_dir=tmp_path)
    ((episode,),) = [task["episodes"] for task in result["tasks"]]
    assert (episode["steps"], episode.get("failure_reason")) == (3, None)


def observation(size: int = 64, **changes: Any) -> dict[str, Any]:
    rng = np.random.default_rng(0)
    images = {name: rng.integers(0, 256, (size, size, 3), dtype=np.uint8) for name in ("workspace", "wrist")}
    state = np.array([0.0, 0.0, 0.1, 0.04], dtype=np.float32)
    text = "Place the black stone on row 2, column 3."
    return {"images": images, "states": state, "task_description": text, **changes}


def begin(server: CheckpointServer, session: str) -> SessionContext:
    """An episode of another benchmark than BOMB."""
    context = SessionContext(session, f"episode of {session}")
    asyncio.run(server.on_episode_start({"task": {"name": "elsewhere"}}, context))
    return context


def end(server: CheckpointServer, context: SessionContext) -> None:
    asyncio.run(server.on_episode_end({}, context))


def first_action(server: CheckpointServer, observed: dict[str, Any]) -> np.ndarray:
    context = begin(server, "a session")
    try:
        return server.predict(observed, context)["actions"]
    finally:
        end(server, context)


def test_cameras_of_other_names_and_sizes_are_mapped_and_resized(server: CheckpointServer) -> None:
    elsewhere = CheckpointServer(
        "bomb:fdvla", device="cpu", cameras={"workspace": "front"}, resize=True, policy={"noise_seed": 0}
    )
    here = CheckpointServer("bomb:fdvla", device="cpu", policy={"noise_seed": 0})
    plain = observation()
    images = {name: image.repeat(2, axis=0).repeat(2, axis=1) for name, image in plain["images"].items()}
    images["front"] = images.pop("workspace")
    action = first_action(elsewhere, plain | {"images": images})
    assert action.shape == (4,) and action.dtype == np.float32
    np.testing.assert_array_equal(action, first_action(here, plain))
    assert elsewhere.get_observation_spec().keys() == {"front", "wrist", "language", "state"}


@pytest.mark.parametrize(
    ("observed", "message"),
    [
        (observation(images={}), "reads observation.images.workspace, and the benchmark sends the cameras"),
        (
            observation(size=128),
            "64x64 pixels, and those of the camera workspace have 128x128",
        ),
        (observation(states=np.zeros(8)), "reads a state of shape (4,), and the benchmark sends (8,)"),
        (observation(states=None), "sends none; many send it with observation_params"),
    ],
)
def test_an_observation_that_the_policy_cannot_read_is_told(
    observed: dict[str, Any], message: str, server: CheckpointServer
) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        first_action(server, observed)


def test_another_session_waits_until_the_episode_has_ended(server: CheckpointServer) -> None:
    first, second = begin(server, "first"), begin(server, "second")
    server.predict(observation(), first)
    with pytest.raises(RuntimeError, match="start a server for each shard"):
        server.predict(observation(), second)
    end(server, second)  # was none
    server.predict(observation(), first)
    again = begin(server, "first")  # its episode broke off
    server.predict(observation(), again)
    end(server, first)  # told late
    server.predict(observation(), again)
    end(server, again)
    second = begin(server, "second")
    server.predict(observation(), second)
    end(server, second)


def test_the_extra_is_named_where_vla_eval_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "vla_eval", None)
    monkeypatch.setattr(sys, "argv", ["harness"])
    monkeypatch.delitem(sys.modules, "lerobot_bomb.harness")
    with pytest.raises(ModuleNotFoundError, match=re.escape("pip install 'lerobot_policy_bomb[vla-eval]'")):
        importlib.import_module("lerobot_bomb.harness")
