"""Recorders that are killed and disturbed at an exact moment.

A server imports LeRobot once and forks a process for each recording, which runs the command line in
blocks of 2 episodes. In that process an audit hook counts Python's file operations in one folder and acts
just before the chosen one. Simulator workers import this file's head, so it is light.
"""

import json
import os
import re
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

OPERATIONS = ("open", "os.mkdir", "os.rename", "os.remove", "os.rmdir")
TIMEOUT_S = 120  # against hangs
MARK = "RECORDER_UNDER_TEST"


@dataclass(frozen=True)
class Moment:
    """The `count`-th operation that matches `pattern`, as "os.rename .*block.json", and what happens."""

    action: str = "kill"
    pattern: str = ""
    count: int = 1


@dataclass(frozen=True)
class Ended:
    """A recorder that has ended."""

    exit_code: int | None  # None: killed
    messages: list[str]  # lines of stderr
    operations: list[str]  # as Moment.pattern sees them


class Recorder:
    """A recorder in a process of its own."""

    def __init__(self, pid: int, log: Path) -> None:
        self.pid = pid
        self._log = log

    def wait(self) -> Ended:
        """Wait until it and its workers have ended."""
        wait_for_end([self.pid])
        wait_for_end(marked_processes(str(self._log)))
        code = self._log.with_suffix(".code")
        return Ended(
            exit_code=int(code.read_text()) if code.exists() else None,
            messages=re.split(r"[\r\n]+", self._log.with_suffix(".err").read_text()),
            operations=self._log.with_suffix(".operations").read_text().splitlines(),
        )


class RecorderServer:
    """Starts recorders; `folder` keeps their logs and is their TMPDIR."""

    def __init__(self, folder: Path) -> None:
        self.temporary = folder / "tmp"
        self.temporary.mkdir()
        self._logs = folder
        self._num_started = 0
        self._process = subprocess.Popen(
            [sys.executable, __file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"TMPDIR": str(self.temporary)},
        )

    def start(self, root: Path, *flags: str, moment: Moment | None = None) -> Recorder:
        """Start `lerobot-bomb record --root=ROOT FLAGS`."""
        self._num_started += 1
        log = self._logs / f"{self._num_started}"
        argv = ["record", f"--root={root}", *flags]
        job = {"argv": argv, "watch": str(root), "log": str(log), "moment": moment and asdict(moment)}
        assert self._process.stdin is not None and self._process.stdout is not None
        print(json.dumps(job), file=self._process.stdin, flush=True)
        return Recorder(int(self._process.stdout.readline()), log)

    def record(self, root: Path, *flags: str, moment: Moment | None = None) -> Ended:
        """Start a recorder and wait for its end."""
        return self.start(root, *flags, moment=moment).wait()

    def close(self) -> None:
        """End the server; recorders have ended before."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(TIMEOUT_S)


def marked_processes(value: str) -> list[int]:
    """Processes that were started with the environment variable MARK=value."""
    mark = f"{MARK}={value}\0".encode()
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            environment = (process / "environ").read_bytes()
        except (FileNotFoundError, ProcessLookupError, PermissionError):
            continue  # it ended, or is another user's
        if mark in environment:
            found.append(int(process.name))
    return found


def wait_for_end(pids: list[int]) -> None:
    """Wait until these processes have ended by themselves."""
    for pid in pids:
        try:
            process = os.pidfd_open(pid)
        except ProcessLookupError:
            continue
        ended, _, _ = select.select([process], [], [], TIMEOUT_S)
        os.close(process)
        assert ended, f"process {pid} has not ended after {TIMEOUT_S} s"


def act(action: str, folder: Path) -> None:
    """Perform an action at its moment."""
    if action == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    elif action == "Ctrl-C":
        time.sleep(0.3)  # workers that were started just before are importing then
        os.killpg(0, signal.SIGINT)  # a terminal sends it to the workers too
    elif action == "terminate":
        os.kill(os.getpid(), signal.SIGTERM)
    elif action == "wait":
        while not folder.with_suffix(".go").exists():
            time.sleep(0.01)
    elif action == "fill the disk":
        with (folder.parent / "filler").open("wb", buffering=0) as filler:
            while True:
                filler.write(bytes(4096))


def hook(moment: Moment | None, watched: str, operations: int) -> Callable[[str, tuple], None]:
    """An audit hook that notes the operations below `watched` in a file and acts at the moment."""
    seen = 0
    done = False

    def on_event(event: str, args: tuple) -> None:
        nonlocal seen, done
        if event not in OPERATIONS or done:
            return
        paths = [os.fsdecode(arg) for arg in args[:2] if isinstance(arg, str | bytes)]
        if not any(path.startswith(watched) for path in paths):
            return
        operation = f"{event} {' '.join(path.removeprefix(watched) for path in paths)}"
        os.write(operations, f"{operation}\n".encode())
        if moment is not None and re.search(moment.pattern, operation):
            seen += 1
            if seen == moment.count:
                done = True
                try:
                    act(moment.action, Path(watched))
                except OSError:
                    assert moment.action == "fill the disk"

    return on_event


def run(job: dict) -> None:
    """Run the recorder that the job describes, and end."""
    from lerobot_bomb.commands import main as cli

    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background starts ignoring it
    os.setpgid(0, 0)
    log = Path(job["log"])
    os.environ[MARK] = str(log)
    null = os.open(os.devnull, os.O_RDWR)
    errors = os.open(log.with_suffix(".err"), os.O_WRONLY | os.O_CREAT)
    for descriptor, target in ((null, 0), (null, 1), (errors, 2)):
        os.dup2(descriptor, target)
    operations = os.open(log.with_suffix(".operations"), os.O_WRONLY | os.O_CREAT)
    moment = job["moment"] and Moment(**job["moment"])
    sys.addaudithook(hook(moment, job["watch"], operations))
    try:
        code = cli.main(job["argv"])
    except SystemExit as error:
        code = error.code
    log.with_suffix(".code").write_text(str(code))
    os._exit(0)


def serve() -> None:
    """Fork a recorder for each line of stdin and print its process id."""
    # the seconds that recorders save
    from lerobot_bomb.commands import record  # noqa: F401
    from lerobot_bomb.data import blocks, resumable  # noqa: F401
    from lerobot_env_bomb.shared.backend import ensure_gl_backend

    ensure_gl_backend()
    resumable.BLOCK_EPISODES = 2
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # ended recorders leave no zombies
    for line in sys.stdin:
        pid = os.fork()
        if pid == 0:
            run(json.loads(line))
        print(pid, flush=True)


if __name__ == "__main__":
    serve()
