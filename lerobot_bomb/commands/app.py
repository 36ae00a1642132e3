"""``lerobot-bomb app``: a page in the browser on which policies act in the simulator."""

import argparse
import contextlib
import tempfile
from importlib.util import find_spec
from pathlib import Path

from lerobot_bomb.commands.app_runs import Commands, check_policy_name
from lerobot_bomb.commands.arguments import path_flag, switch
from lerobot_bomb.commands.serve import LOOPBACK, check_listening, check_port_number
from lerobot_bomb.results.names import SHIPPED_PREFIX

DEFAULT_PORT = 7860


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare where the page is served, and which policy it begins with."""
    add = parser.add_argument
    about = "policy that is chosen first: a folder, bomb:NAME, or USER/NAME on the Hub"
    add("--policy.path", dest="first_policy", default=f"{SHIPPED_PREFIX}fdvla_suites", help=about)
    add("--host", default=LOOPBACK, help=f"address to listen on (default: {LOOPBACK}, this machine only)")
    add("--port", type=int, default=DEFAULT_PORT, help=f"port to listen on (default: {DEFAULT_PORT})")
    about = "allow a --host that other machines reach: they can then run policies and read files of these"
    add("--allow_network", **switch(), help=about)
    add("--output", type=path_flag, help="folder for videos and pages (default: a temporary one)")


def run(args: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C."""
    check_port_number(args.port)
    if find_spec("gradio") is None:
        raise RuntimeError("the app needs gradio: pip install 'lerobot_policy_bomb[app]'")
    check_policy_name(args.first_policy)
    check_listening(args.host, args.port, args.allow_network)
    with contextlib.ExitStack() as stack:
        folder = args.output or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        folder.mkdir(parents=True, exist_ok=True)
        with Commands(folder) as commands:
            from lerobot_bomb.commands.app_page import THEME, app_page  # gradio: seconds

            print(f"http://{args.host}:{args.port} shows the app; Ctrl-C ends it", flush=True)
            app_page(commands, args.first_policy).launch(
                server_name=args.host,
                server_port=args.port,
                share=False,
                theme=THEME,
                allowed_paths=[str(folder)],
                quiet=True,
            )
    return 0
