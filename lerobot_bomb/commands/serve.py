"""``lerobot-bomb serve``: LeRobot's server of action chunks, which knows the policy types of plugins too.

The robot's machine runs LeRobot's own client: ``python -m lerobot.async_inference.robot_client``.
"""

import argparse
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from ipaddress import ip_address

from lerobot_bomb.commands.arguments import path_flag, switch
from lerobot_bomb.compat.own.serving import serve_registered_policies

LOOPBACK, MAX_PORT = "127.0.0.1", 65535
# LeRobot's flags of the server, with its defaults but for the host
SERVER_FLAGS = {
    "host": (LOOPBACK, "Host address to bind the server to"),
    "port": (8080, "Port number to bind the server to"),
    "fps": (30, "Frames per second"),
    "inference_latency": (1 / 30, "Target inference latency in seconds"),
    "obs_queue_timeout": (2.0, "Timeout for observation queue in seconds"),
}
WARNING = (
    "The server trusts its network: there is no password and no encryption, and whoever reaches it can have "
    "it load any checkpoint, and reads the actions. It unpickles what it receives: LeRobot's messages, "
    "arrays, tensors; it refuses the rest. LeRobot's client unpickles whatever a server sends. By default "
    f"only this machine reaches it; let another in through a tunnel (ssh -L 8080:{LOOPBACK}:8080 MACHINE)."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of LeRobot's policy_server, and who may connect."""
    parser.description = WARNING
    add = parser.add_argument
    for name, (default, about) in SERVER_FLAGS.items():
        add(f"--{name}", type=type(default), default=default, help=f"{about} (default: {default})")
    about = "allow a --host that other machines reach: they can use this server as you can"
    add("--allow_network", **switch(), help=about)
    about = "listen on this Unix socket, which only you can open, in place of a port"
    add("--socket", type=path_flag, default=None, metavar="PATH", help=about)


def run(args: argparse.Namespace) -> int:
    """Serve until Ctrl-C; a client names the checkpoint."""
    if args.fps < 1:
        raise ValueError(f"--fps={args.fps} must be at least 1")
    check_port_number(args.port)
    if find_spec("grpc") is None:  # LeRobot's own extra, which few need
        raise RuntimeError("the server needs grpc: pip install 'lerobot_policy_bomb[async]'")
    with _address(args) as address:
        # LeRobot and torch: seconds
        from lerobot.async_inference.configs import PolicyServerConfig

        from lerobot_bomb.serving.open_streams import WORKERS, OpenStreams
        from lerobot_bomb.serving.unpickling import loads

        config = PolicyServerConfig(**{name: getattr(args, name) for name in SERVER_FLAGS})
        server = serve_registered_policies(config, address, loads, OpenStreams(), WORKERS)
        print(f"Serving on {address}. {WARNING}", file=sys.stderr, flush=True)
        try:
            server.wait_for_termination()
        finally:
            server.stop(grace=None)
    return 0


@contextmanager
def _address(args: argparse.Namespace) -> Iterator[str]:
    """Yield the address to listen on, as gRPC names it; a socket is removed afterwards.

    Raises:
        ValueError: the address is in use, or other machines would reach it.
    """
    if args.socket is None:
        check_listening(args.host, args.port, args.allow_network)
        yield f"{args.host}:{args.port}"
        return
    path = args.socket.absolute()
    if path.exists() or not path.parent.is_dir():
        state = "exists already" if path.exists() else "is in no folder that exists"
        raise ValueError(f"--socket={args.socket} {state}; name a new file in an existing folder")
    try:
        yield f"unix:{path}"
    finally:
        path.unlink(missing_ok=True)


def check_port_number(port: int) -> None:
    """Raise a ValueError unless this may be a port."""
    if not 1 <= port <= MAX_PORT:
        raise ValueError(f"--port={port} must lie in 1..{MAX_PORT}")


def check_listening(host: str, port: int, allow_network: bool) -> None:
    """Raise a ValueError unless the port is free and, without `allow_network`, open to this machine only."""
    try:
        with socket.create_server((host, port)) as listener:
            address = ip_address(listener.getsockname()[0])
    except OSError as error:
        raise ValueError(f"--host={host} --port={port}: {str(error.strerror).partition(' (')[0]}") from None
    if not (address.is_loopback or allow_network):
        raise ValueError(
            f"--host={host} lets other machines in, who need no password: leave it out and use a tunnel "
            f"(ssh -L {port}:{LOOPBACK}:{port} MACHINE), or add --allow_network"
        )
