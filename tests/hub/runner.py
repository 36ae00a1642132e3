"""Runs commands against a loopback Hub, several in one process, which saves imports of LeRobot.

As a script: a JSON list of command lines on stdin, run in order; "forget" empties HF_HOME.
"""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

LOOPBACK = "127.0.0.1"
FORGET = ["forget"]
TIMEOUT_S = 280


@dataclass(frozen=True)
class Ended:
    """Output of a process that ended, and its exit code."""

    code: int
    text: str


def environment(endpoint: str, home: Path, token: str | None) -> dict[str, str]:
    """Return the environment of a process that knows no other Hub and no other cache."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("HF_")}
    added = {"HF_ENDPOINT": endpoint, "HF_HOME": str(home), "HF_HUB_DISABLE_XET": "1"}
    added |= {"HF_HUB_DISABLE_TELEMETRY": "1", "OMP_NUM_THREADS": "1"}
    return kept | added | ({} if token is None else {"HF_TOKEN": token})


def run(commands: Sequence[Sequence[str]], endpoint: str, home: Path, token: str | None) -> Ended:
    """Run commands in one process, up to the first that fails."""
    ended = subprocess.run(
        [sys.executable, __file__],
        input=json.dumps([list(command) for command in commands]),
        env=environment(endpoint, home, token),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    return Ended(ended.returncode, ended.stdout)


def only_loopback(event: str, args: tuple) -> None:
    """End this process when anything looks up or connects to another machine: an audit hook."""
    if event == "socket.getaddrinfo":
        host = args[0]
    elif event == "socket.connect" and isinstance(args[1], tuple):
        host = args[1][0]
    else:
        return
    if host not in (LOOPBACK, "localhost", None):
        os.write(2, f"a request to {host}\n".encode())
        os._exit(99)


def main() -> None:
    """Run what stdin says."""
    sys.addaudithook(only_loopback)
    for name, *flags in json.load(sys.stdin):
        print(f"--- {name}", flush=True)
        if [name] == FORGET:
            shutil.rmtree(os.environ["HF_HOME"], ignore_errors=True)
        elif name == "lerobot-bomb":
            from lerobot_bomb.commands.main import main as bomb

            code = bomb(flags)
            if code:
                sys.exit(code)
        elif name == "python":
            exec(flags[0], {})
        else:
            from lerobot.scripts import lerobot_eval, lerobot_train

            sys.argv = [name, *flags]
            {"lerobot-eval": lerobot_eval.main, "lerobot-train": lerobot_train.main}[name]()


if __name__ == "__main__":
    main()
