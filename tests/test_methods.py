"""Methods beside every rate: what the policy does by its config, in the pages and on the model card."""

import re
from pathlib import Path
from typing import Any

import draccus
import pytest
import yaml
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.policies.factory import get_policy_class
from lerobot.utils.import_utils import register_third_party_plugins
from policy_cases import CASES

from lerobot_bomb.checkpoints.shipped import FOLDER, shipped_names
from lerobot_bomb.hub.card import Checkpoint

ROOT = Path(__file__).parents[1]
COLUMN = "settings (many differ from the paper's)"
OF_ALL_SUITES = [name for name in shipped_names() if name.endswith("_suites")]


@pytest.fixture(scope="module", autouse=True)
def plugin() -> None:
    register_third_party_plugins()


def methods(policy_type: str, recipe: str = "all_targets") -> list[str]:
    written = yaml.safe_load((ROOT / "configs" / f"{recipe}_{policy_type}.yaml").read_text())
    config: Any = draccus.decode(TrainPipelineConfig, written).policy
    config.output_features = {"action": PolicyFeature(FeatureType.ACTION, (4,))}
    return config.methods()


def of_recipe(policy_type: str, recipe: str = "all_targets") -> str:
    return "; ".join(methods(policy_type, recipe))


def methods_of_shipped(name: str) -> list[str]:
    config: Any = PreTrainedConfig.from_pretrained(FOLDER / name)
    return config.methods()


def of_shipped(name: str) -> str:
    return "; ".join(methods_of_shipped(name))


def tables(page: str) -> list[list[list[str]]]:
    """Return each table of a page as rows of cells, the header first."""
    found: list[list[list[str]]] = [[]]
    for line in (ROOT / page).read_text().splitlines():
        if not line.startswith("|"):
            found.append([])
        elif not line.startswith("|---"):
            found[-1].append([cell.strip() for cell in line.strip("|").split("|")])
    return [table for table in found if table]


def cells(page: str) -> list[tuple[str, str]]:
    """(first cell, methods) of every row that has them."""
    return [
        (row[0], row[column])
        for header, *rows in tables(page)
        for column, title in enumerate(header)
        if title.startswith(COLUMN)
        for row in rows
    ]


def names_of(cell: str) -> str:
    """vla0_smol of [`vla0_smol`](docs/vla0_smol.md)."""
    (name,) = re.findall(r"^\[?`(?:bomb:)?(\w+)`", cell)
    return name


def test_the_page_of_results_says_what_the_configs_do() -> None:
    assert {names_of(cell): written for cell, written in cells("docs/results.md")} == {
        **{name: of_recipe(name) for name in CASES},
        **{name: of_shipped(name) for name in OF_ALL_SUITES},
    }


def test_the_readme_says_what_the_configs_do() -> None:
    """Check each policy's own methods, and those that it says all of them use."""
    (shared,) = re.findall(r"^All six: (.*?)\.", (ROOT / "README.md").read_text(), re.M | re.S)
    shared = " ".join(shared.split()).split("; ")
    used = {name: methods(name) for name in CASES}
    used |= {name: methods_of_shipped(name) for name in OF_ALL_SUITES}
    assert {name: [each for each in used[name] if each in shared] for name in used} == dict.fromkeys(
        used, shared
    )
    assert {names_of(cell): written for cell, written in cells("README.md")} == {
        name: "; ".join(each for each in used[name] if each not in shared) for name in used
    }


def test_the_shipped_checkpoints_use_the_same_methods() -> None:
    for name in CASES:
        assert of_shipped(name) == of_recipe(name)


def test_one_target_and_all_targets_are_of_the_same_methods() -> None:
    for name in CASES:
        assert of_recipe(name, "one_target") == of_recipe(name)


def test_what_each_type_says() -> None:
    fdvla, grid, text = (CASES[name].make_config for name in ("fdvla", "spatialvla_grid", "vla0_smol"))
    jitter, half = [0.2, 0.2, 0.2, 0.05], {"chunk_size": 10, "n_action_steps": 5}
    assert text(relative_actions=True, color_jitter=jitter, **half).methods()[1:] == [
        "chunk of 10, 5 executed",
        "crop to 0.875",
        "robot state as input",
        "actions relative to the state",
        "masking up to 15 % (value)",
        "colour jitter",
    ]
    assert text(mask_skip_prob=1.0, crop_fraction=1.0, use_state=False).methods()[-5:] == [
        "no crop",
        "no robot state",
        "actions not made relative to the state",
        "no masking",
        "no colour jitter",
    ]
    assert grid(depth_source="observation", n_action_steps=1, temporal_ensemble_size=4).methods() == [
        "one token per group (polar 16 x 32 x 8, 16 cells, adaptive gaussian edges)",
        "chunk of 4, 1 executed",
        "ensemble of 4 (adaptive)",
        "crop to 0.9",
        "no robot state",
        "3-D positions by depth (observation)",
    ]
    assert fdvla(use_denoise_head=False, dualmod_flow=False).methods()[:3] == [
        "flow head",
        "none modulated by the instruction",
        "flow sampler (3 steps)",
    ]


def test_the_model_card_says_it() -> None:
    for name in CASES:
        config = PreTrainedConfig.from_pretrained(FOLDER / name)
        method: Any = getattr(get_policy_class(name), "method")  # noqa: B009  LeRobot's class has none
        card = Checkpoint(config=config, method=method, repo_id="me/x").card()
        assert f"Methods used in this checkpoint: {of_shipped(name)}." in str(card)
