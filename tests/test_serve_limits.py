"""`lerobot-bomb serve` and clients that are not LeRobot's: idle ones, and pickles that run something."""

import os
import pickle
import stat
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import grpc
import numpy as np
import pytest
import torch
from lerobot.async_inference.helpers import RemotePolicyConfig, TimedObservation
from lerobot.transport import services_pb2, services_pb2_grpc

from lerobot_bomb.commands import main as cli
from lerobot_bomb.commands import serve
from lerobot_bomb.serving.open_streams import MAX_OPEN, OpenStreams
from lerobot_bomb.serving.unpickling import loads

CTRL_C = 130
TIMEOUT_S = 60  # against hangs
messages: Any = services_pb2


@pytest.fixture
def served(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[[Callable[[Any, Path], None]], str]:
    """Runs the command on a Unix socket while a client does something; returns what it printed."""
    monkeypatch.chdir(tmp_path)  # LeRobot makes a folder for logs
    path = tmp_path / "socket"
    start = serve.serve_registered_policies

    def run(use: Callable[[Any, Path], None]) -> str:
        def started(*args: Any) -> Any:
            server = start(*args)
            with grpc.insecure_channel(f"unix:{path}") as channel:  # --server_address of LeRobot's client
                use(services_pb2_grpc.AsyncInferenceStub(channel), path)
            monkeypatch.setattr(server, "wait_for_termination", interrupted)
            return server

        monkeypatch.setattr(serve, "serve_registered_policies", started)
        assert cli.main(["serve", f"--socket={path}"]) == CTRL_C
        assert not path.exists()
        return capsys.readouterr().err

    return run


def interrupted() -> None:
    raise KeyboardInterrupt


def test_it_says_whom_it_trusts_and_lets_in_its_owner_only(served: Callable) -> None:
    def use(stub: Any, path: Path) -> None:
        stub.Ready(messages.Empty(), timeout=TIMEOUT_S)
        assert stat.S_IMODE(path.stat().st_mode) & 0o077 == 0
        (path.parent / "new").mkdir()
        assert os.access(path.parent / "new", os.X_OK)  # the usual umask is back

    said = " ".join(served(use).split())
    assert "Serving on unix:" in said
    assert "The server trusts its network" in said
    assert "It unpickles what it receives" in said


def test_clients_that_send_nothing_do_not_keep_others_out(
    monkeypatch: pytest.MonkeyPatch, served: Callable
) -> None:
    monkeypatch.setattr(serve, "OpenStreams", lambda: OpenStreams(timeout_s=10 * TIMEOUT_S))

    def use(stub: Any, path: Path) -> None:
        del path
        release = threading.Event()

        def nothing() -> Iterator[Any]:
            release.wait()
            return
            yield

        ended: SimpleQueue[Any] = SimpleQueue()
        for _ in range(2 * MAX_OPEN):
            stub.SendObservations.future(nothing()).add_done_callback(ended.put)
        try:
            stub.Ready(messages.Empty(), timeout=TIMEOUT_S)
            codes = {ended.get(timeout=TIMEOUT_S).code() for _ in range(MAX_OPEN)}
            assert codes == {grpc.StatusCode.CANCELLED}  # the oldest made place
        finally:
            release.set()

    served(use)


def test_a_request_that_never_ends_is_cancelled(monkeypatch: pytest.MonkeyPatch, served: Callable) -> None:
    monkeypatch.setattr(serve, "OpenStreams", lambda: OpenStreams(timeout_s=0.2))

    def use(stub: Any, path: Path) -> None:
        del path
        release = threading.Event()
        idle = stub.SendObservations.future(iter(release.wait, True))
        try:
            assert idle.exception(TIMEOUT_S).code() == grpc.StatusCode.CANCELLED
        finally:
            release.set()

    served(use)


class Runs:
    """A pickle of it makes a folder where it is loaded."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self) -> tuple:
        return os.mkdir, (str(self.path),)


def test_a_pickle_that_names_a_function_is_refused_before_it_runs(served: Callable) -> None:
    def use(stub: Any, path: Path) -> None:
        folder = path.with_name("made")
        observation = TimedObservation(0.0, 0, {"a": Runs(folder)})
        for data in (pickle.dumps(Runs(folder)), pickle.dumps(observation)):
            stub.Ready(messages.Empty(), timeout=TIMEOUT_S)
            with pytest.raises(grpc.RpcError, match=r"posix\.mkdir is nothing that LeRobot's client sends"):
                stub.SendPolicyInstructions(messages.PolicySetup(data=data), timeout=TIMEOUT_S)
            chunk = messages.Observation(transfer_state=messages.TRANSFER_END, data=data)
            with pytest.raises(grpc.RpcError, match=r"posix\.mkdir"):
                stub.SendObservations(iter([chunk]), timeout=TIMEOUT_S)
        assert not folder.exists()

    served(use)


@pytest.mark.parametrize("protocol", range(3, pickle.HIGHEST_PROTOCOL + 1))
def test_what_lerobots_client_sends_is_read_as_pickle_reads_it(protocol: int) -> None:
    features: Any = {"observation.state": {"dtype": "float32", "shape": (2,), "names": ["a.pos", "b.pos"]}}
    policy = RemotePolicyConfig("act", "me/x", features, 10, "cpu", {"a": "b"})
    assert vars(loads(pickle.dumps(policy, protocol))) == vars(policy)
    image = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    sent = {
        "a.pos": 1.5,
        "b.pos": np.float32(2.5),
        "front": image,
        "wrist": image[:, ::2],
        "depth": torch.arange(6.0).reshape(2, 3),
        "task": "Place it.",
    }
    observation = TimedObservation(1.0, 3, sent, must_go=True)
    read = loads(pickle.dumps(observation, protocol))
    assert isinstance(read, TimedObservation)
    assert (read.get_timestamp(), read.get_timestep(), read.must_go) == (1.0, 3, True)
    assert read.get_observation().keys() == sent.keys()
    for name, value in sent.items():
        found = read.get_observation()[name]
        assert type(found) is type(value)
        np.testing.assert_array_equal(found, value)


def test_a_tensor_holds_no_pickle_of_its_own(tmp_path: Path) -> None:
    """torch unpickles a tensor's bytes."""

    class Nested:
        def __reduce__(self) -> tuple:
            return torch.storage._load_from_bytes, (pickle.dumps(Runs(tmp_path / "made")),)

    with pytest.raises(Exception, match=r"weights_only|Weights only"):
        loads(pickle.dumps(TimedObservation(0.0, 0, {"a": Nested()})))
    assert not (tmp_path / "made").exists()


def test_a_pickle_changes_no_class_of_the_process() -> None:
    """BUILD with (None, {"get_timestamp": 1}) sets an attribute of the class that GLOBAL named."""
    named = b"\x80\x02clerobot.async_inference.helpers\nTimedObservation\n"
    with pytest.raises(pickle.UnpicklingError, match="a type is no message"):
        loads(named + b"N}X\x0d\x00\x00\x00get_timestampK\x01s\x86b.")
    assert callable(TimedObservation.get_timestamp)


def test_something_else_is_no_message() -> None:
    with pytest.raises(pickle.UnpicklingError, match="a dict is no message"):
        loads(pickle.dumps({}))
    with pytest.raises(pickle.UnpicklingError, match="ended its message"):
        loads(None)
