"""Policy types that learn, and the recipes that train a small one of each on a CPU."""

from pathlib import Path
from typing import Any

import yaml

from lerobot_bomb.presets import FOLDER

# every policy type that learns comes with such a file; every proof runs on all of them
POLICY_TYPES = sorted(path.stem.removeprefix("overfit_") for path in FOLDER.glob("overfit_*.yaml"))


def recipe_path(task: str, policy_type: str) -> Path:
    """Return the config of a recipe; tasks: overfit, one_target, all_targets, pusht, ..."""
    return FOLDER / f"{task}_{policy_type}.yaml"


def read_recipe(task: str, policy_type: str) -> dict[str, Any]:
    """Read a recipe's values."""
    return yaml.safe_load(recipe_path(task, policy_type).read_text())


def last_checkpoint(train_dir: Path) -> Path:
    """Return the folder that `lerobot-train --output_dir=train_dir` leaves as its result."""
    return train_dir / "checkpoints" / "last" / "pretrained_model"
