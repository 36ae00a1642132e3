"""Starts a model server: ``python -m lerobot_bomb.harness --config FILE``; ``vla-eval serve`` runs this file.

The server asks for no password, so it listens on this machine only, unless ``--host`` or ``--address`` says
otherwise.
"""

import logging
import sys

from vla_eval.model_servers.serve import run_server

from lerobot_bomb.harness.checkpoint_server import CheckpointServer

LOOPBACK = "127.0.0.1"
CTRL_C = 130  # exit status, as shells have it


def run_checkpoint_server() -> None:
    """Serve until Ctrl-C; a checkpoint that cannot be served is an error of one line."""
    sys.argv.insert(1, f"--host={LOOPBACK}")  # a later flag, or the file, prevails
    logging.getLogger("vla_eval").setLevel(logging.INFO)  # where it listens, and who comes
    try:
        run_server(CheckpointServer)
    except ValueError as error:
        sys.exit(str(error))
    except KeyboardInterrupt:
        sys.exit(CTRL_C)


if __name__ == "__main__":
    run_checkpoint_server()
