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
import pytest
from lerobot.async_inference.helpers import TimedObservation
from lerobot.transport import services_pb2, services_pb2_grpc

from lerobot_bomb.commands import main as cli
from lerobot_bomb.commands import serve
from lerobot_bomb.serving import open_streams
from lerobot_bomb.serving.open_streams import MAX_OPEN, OpenStreams

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
    monkeypatch.setattr(open_streams, "OpenStreams", lambda: OpenStreams(timeout_s=10 * TIMEOUT_S))

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
    monkeypatch.setattr(open_streams, "OpenStreams", lambda: OpenStreams(timeout_s=0.2))

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
