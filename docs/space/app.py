"""The app as a Space of the Hub."""

import sys

from lerobot_bomb.commands.main import main

if __name__ == "__main__":
    sys.exit(main(["app", "--host=0.0.0.0", "--allow_network"]))
