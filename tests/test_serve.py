"""`lerobot-bomb serve` and LeRobot's own client: BOMB gets what the policy foresees here."""

import socket
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
import torch
from fresh_processes import FreshProcess
from lerobot.async_inference.configs import PolicyServerConfig
from robot_cases import BombArm, Loaded

from lerobot_bomb.commands import main as cli
from lerobot_bomb.commands.serve import SERVER_FLAGS
from lerobot_bomb.data.record import record
from lerobot_bomb.data.recording import Recording

REPO_ID, TASK = "test/serve", "Place the black stone on row 2, column 3."
CHUNK = 6
NUM_ACTIONS = 3 * CHUNK + 1
TIMEOUT_S = 120  # against hangs
CTRL_C = 130
SMALL = {
    "fdvla": "--policy.image_size=56 --policy.head_dim=32 --policy.dualmod_dim=16",
    "spatialvla_grid": "",
    "vla0_smol": "",
}


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


def answers(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), timeout=1).close()
    except OSError:
        return False
    return True


@pytest.fixture(scope="module")
def port(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """Start a server in a process of its own, which Ctrl-C ends, and yield its port."""
    number = free_port()
    program = "import sys; from lerobot_bomb.commands.main import main; sys.exit(main(sys.argv[1:]))"
    flags = f"--port={number}", "--inference_latency=0"
    server = FreshProcess(program, "serve", *flags, cwd=tmp_path_factory.mktemp("server"))
    yield number
    server.press_ctrl_c()
    ended = server.wait()
    assert ended.returncode == CTRL_C, ended.stderr


@pytest.fixture(scope="module")
def dataset(port: int, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A demonstration; the server starts meanwhile."""
    root = tmp_path_factory.mktemp("recorded") / "dataset"
    record(Recording(REPO_ID, episodes=1, seed=3, image_size=64, images=True), root)
    return root


@pytest.mark.one_type
def test_bomb_gets_the_chunks_that_the_policy_foresees_here(
    policy_type: str,
    port: int,
    dataset: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path = tmp_path / "checkpoint"
    flags = f"--policy.type={policy_type} --policy.vlm_model_name=nano --policy.device=cpu"
    flags += f" --policy.chunk_size={CHUNK} --policy.n_action_steps={CHUNK} --policy.dtype=float32"
    data = [f"--dataset.repo_id={REPO_ID}", f"--dataset.root={dataset}", f"--output={path}"]
    assert cli.main(["checkpoint", "init", *flags.split(), *SMALL[policy_type].split(), *data]) == 0
    wait_until(lambda: answers(port))
    monkeypatch.chdir(tmp_path)  # LeRobot makes a folder for logs where it is imported
    from lerobot.async_inference import robot_client

    client: Any = robot_client
    seen, chunks = tap(client.RobotClient, monkeypatch)
    flags = f"--policy_type={policy_type} --pretrained_name_or_path={path} --actions_per_chunk={CHUNK}"
    flags += f" --robot.type=bomb_arm --robot.stop_after={NUM_ACTIONS} --robot.calibration_dir={tmp_path}"
    flags += f" --server_address=127.0.0.1:{port} --aggregate_fn_name=latest_only"
    monkeypatch.setattr(sys, "argv", ["robot_client", *flags.split(), f"--task={TASK}"])
    with pytest.raises(KeyboardInterrupt):
        client.async_client()

    loaded = Loaded.of(path)
    foreseen: dict[int, list[torch.Tensor]] = {}  # actions by the step that they are for
    for first_step, received in chunks:
        chunk = loaded.policy.predict_action_chunk(loaded.batch(seen[first_step], TASK))
        torch.testing.assert_close(received, loaded.physical(chunk), rtol=0, atol=1e-5)
        for step, action in enumerate(received, start=first_step):
            foreseen.setdefault(step, []).append(action)
    executed = BombArm.made[-1].executed
    assert len(executed) == NUM_ACTIONS and len(chunks) >= 3
    for step, action in enumerate(executed):
        assert any(torch.equal(torch.from_numpy(action), each) for each in foreseen[step]), step


def tap(
    client: Any, monkeypatch: pytest.MonkeyPatch
) -> tuple[dict[int, dict], list[tuple[int, torch.Tensor]]]:
    """Tap what the client sends by its step, and the chunks (K, D) that it gets, with their first step."""
    seen, chunks = {}, []
    send, take = client.send_observation, client._aggregate_action_queues

    def sent(self: Any, timed: Any) -> bool:
        seen[timed.get_timestep()] = {k: v for k, v in timed.get_observation().items() if k != "task"}
        return send(self, timed)

    def taken(self: Any, timed: list, aggregate: Callable) -> None:
        chunks.append((timed[0].get_timestep(), torch.stack([each.get_action() for each in timed])))
        take(self, timed, aggregate)

    monkeypatch.setattr(client, "send_observation", sent)
    monkeypatch.setattr(client, "_aggregate_action_queues", taken)
    return seen, chunks


def wait_until(happened: Callable[[], bool]) -> None:
    started = time.monotonic()
    while not happened():
        assert time.monotonic() - started < TIMEOUT_S
        time.sleep(0.1)


@pytest.mark.parametrize(
    ("flag", "message"),
    [
        ("--port=99999", "--port=99999 must lie in 1..65535"),
        ("--fps=0", "--fps=0 must be at least 1"),
        ("--host=nowhere.invalid", "--host=nowhere.invalid --port=8080: "),
        ("--host=0.0.0.0", "--host=0.0.0.0 lets other machines in, who need no password"),
        ("--socket=/nowhere/x", "--socket=/nowhere/x is in no folder that exists"),
    ],
)
def test_a_wrong_flag_is_named(flag: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["serve", flag]) == 1
    assert capsys.readouterr().err.startswith(f"lerobot-bomb serve: {message}")


def test_a_port_in_use_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0), reuse_port=True) as other:  # as grpc's
        port = other.getsockname()[1]
        assert cli.main(["serve", f"--port={port}"]) == 1
    message = f"--host=127.0.0.1 --port={port}: Address already in use"
    assert capsys.readouterr().err == f"lerobot-bomb serve: {message}\n"


def test_help_names_the_danger_and_the_host(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main(["serve", "--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert "The server trusts its network" in text
    assert "unpickles whatever a server sends" in text
    assert "Host address to bind the server to (default: 127.0.0.1)" in text


def test_the_flags_are_those_of_lerobots_server_but_for_the_host() -> None:
    theirs = {each.name: (each.default, each.metadata["help"]) for each in fields(PolicyServerConfig)}
    assert theirs | {"host": ("127.0.0.1", theirs["host"][1])} == SERVER_FLAGS


def test_the_extra_is_named_where_grpc_is_missing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "grpc", None)
    assert cli.main(["serve"]) == 1
    message = "the server needs grpc: pip install 'lerobot_policy_bomb[async]'"
    assert capsys.readouterr().err == f"lerobot-bomb serve: {message}\n"
