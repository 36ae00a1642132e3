"""``lerobot-bomb serve``: LeRobot's server of action chunks, which knows the policy types of plugins too.

The robot's machine runs LeRobot's own client: ``python -m lerobot.async_inference.robot_client``.
"""

import argparse
import socket
from dataclasses import fields
from typing import cast

from lerobot_bomb._compat import serve_registered_policies

try:
    from lerobot.async_inference.configs import PolicyServerConfig
except ImportError as error:  # LeRobot's own extra, which few need
    raise RuntimeError("the server needs grpc: pip install 'lerobot_policy_bomb[async]'") from error

LOOPBACK = "127.0.0.1"
WARNING = (
    "The server unpickles what it receives: whoever reaches its port can run any code on this machine. By "
    "default that is this machine alone; reach it from another through a tunnel "
    f"(ssh -L 8080:{LOOPBACK}:8080 MACHINE)."
)


def add_serve_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``lerobot-bomb serve``, which are those of LeRobot's policy_server."""
    parser.description = f"{parser.description}. {WARNING}"
    for field in fields(PolicyServerConfig):
        default = LOOPBACK if field.name == "host" else field.default
        value_type = cast("type", field.type)
        about = f"{field.metadata['help']} (default: {default})"
        parser.add_argument(f"--{field.name}", type=value_type, default=default, help=about)


def run_serve(args: argparse.Namespace) -> int:
    """Serve until Ctrl-C; a client names the checkpoint."""
    if args.fps < 1:
        raise ValueError(f"--fps={args.fps} must be at least 1")
    config = PolicyServerConfig(
        **{field.name: getattr(args, field.name) for field in fields(PolicyServerConfig)}
    )
    _check_port(config.host, config.port)
    serve_registered_policies(config)
    return 0


def _check_port(host: str, port: int) -> None:
    """Raise a ValueError unless it is free: grpc would share it, and clients would reach either server."""
    try:
        with socket.create_server((host, port)):
            pass
    except OSError as error:
        raise ValueError(f"--host={host} --port={port}: {str(error.strerror).partition(' (')[0]}") from None
