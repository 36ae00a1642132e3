"""Groups of a policy's flags: what LeRobot's help lists, what the docs list, and that all of them work."""

import re
from dataclasses import fields
from pathlib import Path

import pytest
from lerobot.configs import PreTrainedConfig
from lerobot.configs.parser import print_scoped_help
from lerobot.configs.train import TrainPipelineConfig
from policy_cases import CASES

from lerobot_bomb.policies.flag_groups import flags_of

DOCS = Path(__file__).parents[1] / "docs"
# of LeRobot, and in every policy
LEROBOTS = {"type", "device", "push_to_hub", "repo_id", "private", "tags", "license"}
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


def table(policy_type: str, heading: str) -> set[str]:
    """Return the flags in a table of a policy's page; `optimizer_*` are those that no table names."""
    page = (DOCS / f"{policy_type}.md").read_text()
    flags = page.partition("\n## Flags\n")[2].partition("\n## ")[0]
    named = set(re.findall(r"`([\w*]+)`", "".join(re.findall(r"^\|([^|]*)\|", flags, re.MULTILINE))))
    rows = flags.partition(f"| {heading} | |\n|---|---|\n")[2].partition("\n\n")[0].splitlines()
    names = {name for row in rows for name in re.findall(r"`([\w*]+)`", row.split("|")[1])}
    for pattern in [name for name in names if name.endswith("*")]:
        names.remove(pattern)
        names |= {name for name in names_of(policy_type) if name.startswith(pattern[:-1])} - named
    return names


@pytest.mark.parametrize("name", sorted(CASES))
def test_a_policys_page_has_every_flag_in_its_group(name: str) -> None:
    research = set(flags_of(PreTrainedConfig.get_choice_class(name), "RESEARCH"))
    filled_in = set(flags_of(PreTrainedConfig.get_choice_class(name), "FILLED_IN"))
    told, told_of_research = table(name, "flag"), table(name, "for research, not in `--help`")
    if name == "spatialvla_grid":  # "The others are as for vla0_smol"
        told |= table("vla0_smol", "flag") & {*names_of(name)}
        told_of_research |= table("vla0_smol", "for research, not in `--help`") & {*names_of(name)}
    assert told_of_research == research
    assert told == {*names_of(name)} - research - filled_in - LEROBOTS
