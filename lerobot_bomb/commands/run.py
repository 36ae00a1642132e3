"""Run commands as a user would type them."""

import shlex
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path


def run_command(command: str, *flags: str) -> None:
    """Show a command, then run it from this Python's environment.

    The command inherits files that were made inheritable, so a lock is held until it, too, has ended. It
    ignores Ctrl-C, on which this process ends it: no traceback of it is shown.

    Raises:
        RuntimeError: the command ended with another exit code than 0.
    """
    print(shlex.join([command, *flags]), flush=True)
    path = Path(sys.executable).with_name(command)
    ignore_ctrl_c = partial(signal.signal, signal.SIGINT, signal.SIG_IGN)
    status = subprocess.run([path, *flags], check=False, close_fds=False, preexec_fn=ignore_ctrl_c).returncode
    if status:
        raise RuntimeError(f"`{command}` ended with exit code {status}; its output is above")
