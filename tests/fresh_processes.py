"""Programs in processes of their own, in which LeRobot is imported already: that takes ten seconds.

A server, which all processes of a test run share, imports LeRobot for the first program, and nothing of ours.
It forks a process for each. What is to happen before LeRobot's import needs a process that is not forked.
"""

import json
import os
import signal
import socket
import subprocess
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile
from typing import Any

ADDRESS = "FRESH_PROCESSES"  # environment variable: the server's socket
TIMEOUT_S = 280  # against hangs


class FreshProcess:
    """A running program; what it prints goes to files."""

    def __init__(
        self, program: str, *argv: str, env: Mapping[str, str] = os.environ, cwd: Path | None = None
    ) -> None:
        self._files = TemporaryFile("w+"), TemporaryFile("w+")  # noqa: SIM115  `wait` closes them
        self._server = socket.socket(socket.AF_UNIX)
        self._server.settimeout(TIMEOUT_S)
        self._server.connect(os.environ[ADDRESS])
        job = {"program": program, "argv": ["-c", *argv], "env": dict(env), "cwd": str(cwd or Path.cwd())}
        socket.send_fds(self._server, [b"+"], [file.fileno() for file in self._files])
        self._server.sendall(json.dumps(job).encode() + b"\n")
        self._answers = self._server.makefile()
        self._pid = int(self._answers.readline())

    def press_ctrl_c(self) -> None:
        os.kill(self._pid, signal.SIGINT)

    def wait(self) -> subprocess.CompletedProcess[str]:
        """Wait for its end."""
        code = int(self._answers.readline())
        self._answers.close()
        self._server.close()
        printed = []
        for file in self._files:
            with file:
                file.seek(0)
                printed.append(file.read())
        return subprocess.CompletedProcess(str(self._pid), code, *printed)


@contextmanager
def serving() -> Iterator[None]:
    """Let this process, and those that it starts, run programs."""
    with TemporaryDirectory() as folder:
        address = str(Path(folder) / "socket")
        command = [sys.executable, __file__, address]
        with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE) as server:
            assert server.stdout is not None and server.stdout.readline()
            os.environ[ADDRESS] = address
            yield
            server.terminate()


def run(job: dict[str, Any], files: list[int]) -> None:
    """Run a program as `python -c` does."""
    for number, file in enumerate(files, start=1):
        os.dup2(file, number)
        os.close(file)
    os.chdir(job["cwd"])
    os.environ.clear()
    os.environ.update(job["env"])
    sys.argv, sys.path[0] = job["argv"], ""
    exec(compile(job["program"], "<string>", "exec"), {"__name__": "__main__"})


def attend(client: socket.socket) -> None:
    """Fork the process that a client wants; tell its number and, in the end, its exit code."""
    _, files, _, _ = socket.recv_fds(client, 1, 2)
    with client.makefile() as lines:
        job = json.loads(lines.readline())
    if (pid := os.fork()) == 0:
        client.close()
        signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background starts ignoring it
        run(job, files)
        sys.exit()
    client.sendall(f"{pid}\n".encode())
    client.sendall(f"{os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])}\n".encode())


def serve(address: str) -> None:
    """Attend to each client in a process of its own, until SIGTERM."""
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(address)
    listener.listen()
    warnings.filterwarnings("ignore", "This process .* is multi-threaded")  # LeRobot's threads only wait
    print("ready", flush=True)
    while True:
        client, _ = listener.accept()
        from lerobot.scripts import lerobot_eval, lerobot_train  # noqa: F401  the seconds that programs save

        assert not [name for name in sys.modules if name.startswith(("lerobot_bomb", "lerobot_policy_"))]
        if os.fork() == 0:
            listener.close()
            attend(client)
            os._exit(0)
        client.close()
        with suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass


if __name__ == "__main__":
    serve(sys.argv[1])
