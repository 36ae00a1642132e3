"""Components that `pyproject.toml` registers beside the tasks, made here: a list of them loads no model."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lerobot_bomb.inspect_robots.embodiment import BombEmbodiment
    from lerobot_bomb.inspect_robots.policy import CheckpointPolicy


def embodiment(**flags: Any) -> "BombEmbodiment":
    """Make BOMB's arm and board; see `BombEmbodiment`."""
    from lerobot_bomb.inspect_robots.embodiment import BombEmbodiment

    return BombEmbodiment(**flags)


def policy(checkpoint: str, **flags: Any) -> "CheckpointPolicy":
    """Load a checkpoint of LeRobot; see `CheckpointPolicy`."""
    from lerobot_bomb.inspect_robots.policy import CheckpointPolicy

    return CheckpointPolicy(checkpoint, **flags)
