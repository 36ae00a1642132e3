"""Groups of a policy's flags: what LeRobot's help lists, what the docs list, and that all of them work."""

import re
from dataclasses import fields
from pathlib import Path

import pytest
from config_fields import own_fields
from lerobot.configs import PreTrainedConfig
from lerobot.configs.parser import print_scoped_help
from lerobot.configs.train import TrainPipelineConfig
from policy_cases import CASES

from lerobot_bomb.policies.flag_groups import flags_of

PAGE = Path(__file__).parents[1] / "docs" / "reference" / "policies.md"
MAX_LISTED = 33


def names_of(policy_type: str) -> list[str]:
    return [each.name for each in fields(PreTrainedConfig.get_choice_class(policy_type))]


@pytest.mark.parametrize("name", sorted(CASES))
def test_the_help_lists_what_a_user_sets(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    config_class = PreTrainedConfig.get_choice_class(name)
    print_scoped_help(TrainPipelineConfig, [f"--policy.type={name}"])
    listed = set(re.findall(r"--policy\.(\w+)(?=[ \n])", capsys.readouterr().out))
    left_out = {*flags_of(config_class, "RESEARCH"), *flags_of(config_class, "FILLED_IN")}
    assert len(listed) <= MAX_LISTED
    assert listed == {"type", *names_of(name)} - left_out - {"rtc_config"}  # flags of its own fields


def test_a_flag_that_is_not_listed_works(tmp_path: Path) -> None:
    CASES["vla0_smol"].make_config().save_pretrained(tmp_path)
    config = PreTrainedConfig.from_pretrained(tmp_path, cli_overrides=["--mask_level=step"])
    assert config.mask_level == "step"  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.parametrize("name", sorted(CASES))
def test_the_reference_lists_every_flag_in_its_group(name: str) -> None:
    tables = {"Listed": set(), "For research": set(), "Filled in": set()}
    for heading in ("Shared", name):
        section = PAGE.read_text().partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
        for title, found in tables.items():
            rows = section.partition(f"\n**{title}")[2].partition("\n**")[0]
            column = sorted(CASES).index(name) if heading == "Shared" and title != "Filled in" else 0
            for flag, cells in re.findall(r"^\| `(?:--policy\.)?(\w+)` \| (.*) \|$", rows, re.M):
                if cells.split("|")[column].strip() != "-":
                    assert flag not in found
                    found.add(flag)
    listed, research, filled_in = tables.values()
    config_class = PreTrainedConfig.get_choice_class(name)
    assert research == {*flags_of(config_class, "RESEARCH")}
    assert filled_in < {*flags_of(config_class, "FILLED_IN")}  # the others are LeRobot's
    assert listed == {each.name for each in own_fields(config_class)} - research - filled_in
