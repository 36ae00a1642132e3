"""Documents: nothing points nowhere, nothing is left to be filled in, commands for robots can be parsed."""

import importlib
import inspect
import re
import shlex
import sys
from dataclasses import is_dataclass
from pathlib import Path
from string import Template
from typing import Any

import draccus
import pytest
import yaml

from lerobot_bomb.bomb.episode import Failure
from lerobot_bomb.checkpoints.names import PREPROCESSOR
from lerobot_bomb.commands import main as cli
from lerobot_bomb.commands.table import COMMANDS
from lerobot_bomb.failures import FailureClass
from lerobot_bomb.libero.episode import LiberoFailure
from lerobot_bomb.pusht.episode import PushTFailure

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
REAL_ROBOT = ROOT / "docs" / "real_robot.md"
NOT_LEROBOTS = {"pip", "ssh"}
WITHOUT_CONFIG = {"lerobot-find-port", "lerobot-find-cameras"}  # read no flags, or one word


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_and_images_exist_and_no_place_is_left_open(page: Path) -> None:
    text = page.read_text()
    links = re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text)
    missing = [link for link in links if "://" not in link and not (page.parent / link).exists()]
    assert missing == []
    assert re.findall(r"\{[A-Z_]{3,}\}|TODO|FIXME", text) == []


def test_every_path_of_a_package_that_the_pages_name_exists() -> None:
    named = {
        path
        for page in [*PAGES, ROOT / "CONTRIBUTING.md"]
        for path in re.findall(r"`((?:envs|policies)/lerobot_[^`\s*]+)`", page.read_text())
        if "NAME" not in path
    }
    assert len(named) > 5
    assert sorted(path for path in named if not (ROOT / path).exists()) == []


def test_the_sites_navigation_is_the_map_of_the_documentation() -> None:
    nav = yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"]
    sections = {name: pages for entry in nav for name, pages in entry.items() if isinstance(pages, list)}
    _, *texts = re.split(r"^## ", (ROOT / "docs" / "README.md").read_text(), flags=re.MULTILINE)
    mapped = {
        text.partition("\n")[0]: [
            {title: link} for title, link in re.findall(r"^- \[(.*?)\]\((.*?)\)", text, re.M)
        ]
        for text in texts
    }
    assert list(sections.items()) == list(mapped.items())


@pytest.mark.parametrize(
    ("name", "classes"),
    [("bomb.md", Failure), ("pusht.md", PushTFailure), ("libero.md", LiberoFailure)],
)
def test_a_page_says_of_each_failure_class_what_the_report_says(
    name: str, classes: type[FailureClass]
) -> None:
    rows = re.findall(r"^\| `(\w+)` \| ([^|]+) \|$", (ROOT / "docs" / name).read_text(), re.M)
    assert {each.value: each.meaning for each in classes}.items() <= dict(rows).items()


def commands(page: Path) -> list[list[str]]:
    """Return the commands of all blocks of a page, as a shell reads them, with the page's variables set."""
    text = "".join(re.findall(r"^```\n(.*?)^```", page.read_text(), flags=re.DOTALL | re.MULTILINE))
    assignment = re.compile(r"^([A-Z]+)='(.*?)'\n", flags=re.DOTALL | re.MULTILINE)
    variables = {name: " ".join(value.split()) for name, value in assignment.findall(text)}
    text = Template(assignment.sub("", text).replace("\\\n", " ")).substitute(variables)
    return [words for line in text.splitlines() if (words := shlex.split(line))]


def parsed(module_name: str, flags: list[str], monkeypatch: pytest.MonkeyPatch) -> Any:
    """The config that a command of LeRobot makes of its flags, by its own parser."""
    module = importlib.import_module(module_name)
    (config_class,) = {
        parameter.annotation
        for function in vars(module).values()
        if getattr(function, "__module__", None) == module_name and hasattr(function, "__wrapped__")
        for parameter in inspect.signature(function).parameters.values()
        if is_dataclass(parameter.annotation)
    }

    def keep(config: Any) -> Any:
        return config

    keep.__annotations__ = {"config": config_class}
    wrap = module.parser.wrap if hasattr(module, "parser") else draccus.wrap
    monkeypatch.setattr(sys, "argv", [module_name, *flags])
    return wrap()(keep)()


def test_the_parsers_read_every_command_for_a_real_robot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from lerobot.policies.factory import make_policy_config
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    monkeypatch.chdir(tmp_path)
    for name, policy_type in {"so101_vla0": "vla0_smol", "so101_fdvla": "fdvla"}.items():
        folder = tmp_path / "outputs" / name / "checkpoints" / "last" / "pretrained_model"
        folder.mkdir(parents=True)
        make_policy_config(policy_type).save_pretrained(folder)
        (folder / PREPROCESSOR).write_text("{}")
    configs: dict[str, list[Any]] = {}
    for command, *flags in commands(REAL_ROBOT):
        if command == "lerobot-bomb":
            name = next(name for name in (" ".join(flags[:2]), flags[0]) if name in COMMANDS)
            monkeypatch.setattr(cli.module_of(name), "run", lambda args: 0)
            assert cli.main(flags) == 0
        elif command == "python":
            configs.setdefault(flags[1], []).append(parsed(flags[1], flags[2:], monkeypatch))
        elif command not in NOT_LEROBOTS:
            module_name = f"lerobot.scripts.{command.replace('-', '_')}"
            if command in WITHOUT_CONFIG:
                importlib.import_module(module_name)
            else:
                configs.setdefault(command, []).append(parsed(module_name, flags, monkeypatch))
    # values that a shell or a parser could have read as something else
    (recording,), (client,) = configs["lerobot-record"], configs["lerobot.async_inference.robot_client"]
    assert recording.dataset.no_stamp and recording.robot.cameras["wrist"].width == 640
    assert client.robot.max_relative_target == 5.0 and client.policy_type == "vla0_smol"
    careful, chunking = configs["lerobot-rollout"]
    assert careful.policy.type == "vla0_smol" and careful.fps == 5
    assert chunking.policy.type == "fdvla" and chunking.inference.queue_threshold == 8
    assert configs["lerobot-train"][0].policy.relative_exclude_joints == ["gripper"]
    assert {config.fps for config in (recording.dataset, client, chunking)} == {15}
