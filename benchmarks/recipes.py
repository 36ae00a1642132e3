"""The policies that learn, and the recipe with which each learns a few episodes by heart."""

from pathlib import Path
from typing import Any

import yaml

FOLDER = Path(__file__).parents[1] / "configs"
# a policy that learns comes with such a file; every proof runs on all of them
POLICY_TYPES = sorted(path.stem.removeprefix("overfit_") for path in FOLDER.glob("overfit_*.yaml"))


def recipe_path(policy_type: str) -> Path:
    """A config for `lerobot-train --config_path`."""
    return FOLDER / f"overfit_{policy_type}.yaml"


def read_recipe(policy_type: str) -> dict[str, Any]:
    """The recipe's values."""
    return yaml.safe_load(recipe_path(policy_type).read_text())
