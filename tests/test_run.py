"""Commands that a command runs."""

import os
import signal
import subprocess
import sys
from functools import partial

CODE = """
import sys
from lerobot_bomb.commands.run import run_command
try:
    run_command("python", "-c", "import time; print('begun', flush=True); time.sleep(60)")
except KeyboardInterrupt:
    sys.exit("interrupted")
"""


def test_ctrl_c_ends_the_command_without_its_traceback() -> None:
    command = [sys.executable, "-c", CODE]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    # a shell starts jobs in the background with SIGINT ignored, which a process passes on
    heard = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    process = subprocess.Popen(command, start_new_session=True, preexec_fn=heard, **pipes)
    assert process.stdout is not None
    while process.stdout.readline() != "begun\n":
        assert process.poll() is None
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does it
    assert process.communicate(timeout=30) == ("", "interrupted\n")  # both have closed their ends
