"""Put a policy that benchmarks/learn.py trained into the package, where `--policy.path=bomb:NAME` finds it.

    python benchmarks/ship.py FOLDER [--name=TYPE_suites]

The weights are the training's own, bit for bit; the configs lose the paths of the machine.
"""

import shutil
from pathlib import Path

from machine import make_parser
from recipes import last_checkpoint

from lerobot_bomb.checkpoints.identity import sha256_of
from lerobot_bomb.checkpoints.names import CONFIG, TRAIN_CONFIG, WEIGHTS
from lerobot_bomb.checkpoints.shipped import FOLDER
from lerobot_bomb.files import read_json
from lerobot_bomb.hub.push import portable_json


def main() -> None:
    """Copy the last checkpoint in place of the one that is there; print its hash and size."""
    parser = make_parser(__doc__)
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="--output_dir of learn.py")
    parser.add_argument("--name", help="after `bomb:` (default: the policy's type)")
    args = parser.parse_args()
    checkpoint = last_checkpoint(args.folder / "train")
    target = FOLDER / (args.name or read_json(checkpoint / CONFIG)["type"])
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(checkpoint, target)
    for name in (CONFIG, TRAIN_CONFIG):
        (target / name).write_text(portable_json(checkpoint / name) + "\n")
    for path in target.iterdir():
        path.chmod(0o644)
    size_mb = sum(path.stat().st_size for path in target.iterdir()) / 1e6
    print(f"{target}: {size_mb:.1f} MB, {WEIGHTS} {sha256_of(target / WEIGHTS)}")


if __name__ == "__main__":
    main()
