"""The pages of docs/reference/ are those that the code gives, and leave nothing out."""

import dataclasses
import re
from difflib import unified_diff
from typing import Any

import pytest
from lerobot.configs import PreTrainedConfig
from lerobot.envs import EnvConfig
from make_reference import FOLDER, ours_of, own_axes, pages, record_types

from lerobot_bomb.commands.main import command_parser
from lerobot_bomb.commands.table import COMMANDS


@pytest.fixture(scope="module")
def made() -> dict[str, str]:
    return pages()


def sections(page: str, level: str = "##") -> dict[str, str]:
    """{heading: its text}."""
    parts = re.split(rf"^{level} (.*)\n", page, flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def first_cells(text: str) -> list[str]:
    """Return the names in the first cell of each row of tables."""
    return [name for row in re.findall(r"^\| (`.*?`) \|", text, re.M) for name in re.findall(r"`(.*?)`", row)]


def test_the_committed_pages_are_the_generated_ones(made: dict[str, str]) -> None:
    committed = {name: (FOLDER / name).read_text().splitlines() for name in made}
    changed = {name: [*unified_diff(committed[name], text.splitlines(), n=0)] for name, text in made.items()}
    assert not any(changed.values()), f"the code has changed, run `make reference`: {changed}"
    assert {path.name for path in FOLDER.iterdir()} == made.keys()


def test_every_command_and_argument_is_there(made: dict[str, str]) -> None:
    found = sections(made["commands.md"], "###")
    assert found.keys() == COMMANDS.keys()
    for name, text in found.items():
        options = {*command_parser(name)._option_string_actions} - {"-h", "--help"}
        linked = re.findall(
            r"`(--env\.\w+)`", "".join(re.findall(r"^\[The environment's flags\].*", text, re.M))
        )
        assert {*linked} <= {*first_cells(made["environments.md"])} - {*first_cells(text)}
        short_forms = {each.replace("--env.", "--") for each in linked}
        assert options <= {*first_cells(text), *linked, *short_forms}
        assert all(f"lerobot-bomb {name} {flags}".rstrip() in text for flags in COMMANDS[name].examples)


@pytest.mark.parametrize(
    ("page", "registry", "prefix", "known"),
    [("policies.md", PreTrainedConfig, "policy", "fdvla"), ("environments.md", EnvConfig, "env", "bomb")],
)
def test_every_field_that_lerobot_does_not_have_is_there(
    page: str, registry: Any, prefix: str, known: str, made: dict[str, str]
) -> None:
    types, found = ours_of(registry), sections(made[page])
    shared = found.pop("Shared", "")
    assert known in types and found.keys() == types.keys()
    for name, config_class in types.items():
        stock = {
            each
            for base in config_class.__mro__
            if base.__module__.startswith("lerobot.")
            for each in vars(base).get("__annotations__", ())
        }
        names = {each.name for each in dataclasses.fields(config_class)} - stock
        text = found[name] + (shared if "(#shared)" in found[name] else "")
        listed = {each.removeprefix(f"--{prefix}.") for each in first_cells(text)}
        assert names <= listed


def test_every_axis_is_there(made: dict[str, str]) -> None:
    axes = {f"{env_type}: {axis}" for env_type, axes in own_axes().items() for axis in axes}
    assert axes == sections(made["axes.md"]).keys() >= {"bomb_libero: camera", "bomb_pusht: goal"}
    assert (
        "| angle | 3 | 6 | 9 | 12.5 | 16 | degrees | around the board, in a random direction |"
        in (FOLDER.parent / "perturbations.md").read_text()
    )


def test_a_shared_flag_has_the_default_of_each_policy(made: dict[str, str]) -> None:
    header, *rows = re.findall(r"^\| (.*) \|$", sections(made["policies.md"])["Shared"], re.M)
    assert header == "flag | fdvla | spatialvla_grid | vla0_smol | meaning"
    cells = {row.partition(" | ")[0]: row.split(" | ")[1:4] for row in rows}
    assert cells["`--policy.n_action_steps`"] == ["`8`", "`4`", "`5`"]
    assert cells["`--policy.relative_actions`"] == ["`false`", "-", "`false`"]


def test_every_field_of_a_record_is_there(made: dict[str, str]) -> None:
    found = sections(made["records.md"])
    shared = {*first_cells(found["All environments"])}
    of_types = {env_type: text for heading, text in found.items() for env_type in heading.split(", ")}
    for record_type in record_types():
        names = {name.partition(".")[0] for name in first_cells(of_types[record_type.env_type])}
        fields = {each.name for each in dataclasses.fields(record_type)}
        assert names | shared == fields and not names & shared
    assert {"policy.weights_sha256", "inference.latency_p50_ms"} <= {*first_cells(made["records.md"])}


def test_every_row_has_a_meaning(made: dict[str, str]) -> None:
    assert [row for text in made.values() for row in re.findall(r"^\| .*\|  \|$", text, re.M)] == []
