"""Recipes in configs/ that train: LeRobot's parser takes each, and an ablation's row changes what it says."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import draccus
import pytest
from lerobot.configs.train import TrainPipelineConfig

from lerobot_policy_vla0_smol import Vla0SmolConfig

CONFIGS = Path(__file__).parents[1] / "configs"
ABLATIONS = {
    "absolute": {"relative_actions": False, "use_state": False},
    "absolute_state": {"relative_actions": False},
    "relative": {"use_state": False},
    "relative_state": {},
    "masking": {"mask_max_fraction": 0.15},
    "frozen_vision": {"use_state": False, "freeze_vision_encoder": True},
    "lr_5e-6": {"use_state": False, "optimizer_lr": 5e-6},
    "lr_1e-5": {"use_state": False, "optimizer_lr": 1e-5},
    "lr_1e-4": {"use_state": False, "optimizer_lr": 1e-4},
    "ensemble": {"temporal_ensemble_size": 10, "n_action_steps": 1},
    "system_prompt": {},
}


def parse(path: Path) -> tuple[TrainPipelineConfig, Vla0SmolConfig]:
    """As `lerobot-train --config_path=` does."""
    config = draccus.parse(TrainPipelineConfig, config_path=path, args=["--policy.device=cpu"])
    assert isinstance(config.policy, Vla0SmolConfig)
    return config, config.policy


@pytest.mark.parametrize("path", sorted(CONFIGS.rglob("*vla0_smol*.yaml")), ids=lambda path: path.stem)
def test_a_recipe_is_taken_and_names_itself(path: Path) -> None:
    config, policy = parse(path)
    assert path.read_text().splitlines()[0].split("--config_path=")[1].split()[0] in path.as_posix()
    # one schedule over the whole training
    assert config.steps <= policy.scheduler_decay_steps
    assert policy.scheduler_decay_lr < policy.optimizer_lr


def test_the_recipe_for_pusht_is_the_ablations_best_row() -> None:
    row = parse(CONFIGS / "ablations" / "vla0_smol_pusht_masking.yaml")
    assert row == parse(CONFIGS / "train_vla0_smol_pusht.yaml")


def test_a_row_is_a_file() -> None:
    names = {path.stem.removeprefix("vla0_smol_pusht_") for path in (CONFIGS / "ablations").iterdir()}
    assert names == ABLATIONS.keys()


@pytest.mark.parametrize("name", ABLATIONS)
def test_a_row_changes_what_it_is_called_after(name: str) -> None:
    config, policy = parse(CONFIGS / "ablations" / f"vla0_smol_pusht_{name}.yaml")
    assert (config.dataset.repo_id, config.batch_size, config.steps) == ("lerobot/pusht", 16, 30_000)
    expected: dict[str, Any] = {
        "relative_actions": True,
        "use_state": True,
        "mask_max_fraction": 0.0,
        "freeze_vision_encoder": False,
        "optimizer_lr": 5e-5,
        "temporal_ensemble_size": 0,
        "n_action_steps": 5,
        **ABLATIONS[name],
    }
    values = asdict(policy)
    assert {key: values[key] for key in expected} == expected
    assert (policy.system_prompt is not None) == (name == "system_prompt")
    assert policy.scheduler_decay_lr == pytest.approx(policy.optimizer_lr / 10)
