"""Runs commands as a user would type them."""

import shlex
import subprocess
import sys
from pathlib import Path


def run_command(command: str, *flags: str) -> None:
    """Show a command, then run it from this Python's environment.

    It inherits the files that were made inheritable: a lock is held until it, too, has ended.

    Raises:
        RuntimeError: it ended with another exit code than 0.
    """
    print(shlex.join([command, *flags]), flush=True)
    path = Path(sys.executable).with_name(command)
    status = subprocess.run([path, *flags], check=False, close_fds=False).returncode
    if status:
        raise RuntimeError(f"`{command}` ended with exit code {status}; its output is above")
