"""Write the pages of docs/reference/ from the code: commands, flags, config fields, axes, fields of records.

``make reference`` runs it; tests/test_reference.py compares the committed pages with what it would write.
"""

import dataclasses
from argparse import SUPPRESS, Action
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

from config_fields import comments_of, default_in, default_of, is_ours, meaning_of, own_fields
from lerobot.configs import PreTrainedConfig
from lerobot.envs import EnvConfig
from lerobot.utils.import_utils import register_third_party_plugins
from policy_flags import FILLED_IN, groups_of, shared_fields

from lerobot_bomb.bomb.perturbations import AXES
from lerobot_bomb.commands.main import Parser, command_parser
from lerobot_bomb.commands.table import COMMANDS, PROGRAM
from lerobot_bomb.conditions import Axis
from lerobot_bomb.environments import BOMB, ENVIRONMENTS
from lerobot_bomb.policies.config import VlaConfig
from lerobot_bomb.results.record import Record
from lerobot_bomb.tables import markdown_table
from lerobot_bomb.viewing.perturbations_page import sizes_table, summary_of

FOLDER = Path(__file__).parent / "reference"
JSON_KINDS = {bool: "true or false", int: "whole number", float: "number", str: "text", Any: "any"}


def argument_rows(parser: Parser) -> dict[str, str]:
    """{spelling: explanation} of the arguments of a command."""
    formatter = parser._get_formatter()
    rows = {}
    for action in parser._actions:
        if action.dest != "help" and action.help != SUPPRESS:
            is_required = " (required)" * bool(action.required and action.option_strings)
            rows[_spelling(action)] = f"{formatter._expand_help(action)}{is_required}"
    return rows


def environment_flags(rows: Iterable[dict[str, str]]) -> set[tuple[str, str]]:
    """Return the rows of environments' flags that several commands explain alike."""
    uses = Counter(row for arguments in rows for row in arguments.items())
    names = {f"--env.{each.name}" for config in ours_of(EnvConfig).values() for each in own_fields(config)}
    return {row for row, count in uses.items() if count > 1 and _long(row[0]) in names}


def _long(spelling: str) -> str:
    """`--env.task`, `--task` -> --env.task."""
    return spelling.split("`")[1]


def _spelling(action: Action) -> str:
    if not action.option_strings:
        return f"`{action.metavar or action.dest.upper()}`"
    return ", ".join(f"`{name}`" for name in action.option_strings)


def commands_page() -> str:
    """Every command with examples and flags."""
    lines = [
        "# Commands",
        "",
        f"All of `{PROGRAM}`, group by group. `{PROGRAM} COMMAND --help` shows the same.",
        "A flag of the environment has a short form: `--task` for `--env.task`.",
        "",
    ]
    arguments = {name: argument_rows(command_parser(name)) for name in COMMANDS}
    linked = environment_flags(arguments.values())
    for group in dict.fromkeys(command.group for command in COMMANDS.values()):
        lines += [f"## {group}", ""]
        for name, command in COMMANDS.items():
            if command.group == group:
                examples = [f"{PROGRAM} {name} {flags}".rstrip() for flags in command.examples]
                summary = f"{command.summary[0].upper()}{command.summary[1:]}."
                lines += [f"### {name}", "", summary, "", "```", *examples, "```", ""]
                rows = [row for row in arguments[name].items() if row not in linked]
                lines += markdown_table("argument | meaning", rows) if rows else []
                flags = ", ".join(f"`{_long(row[0])}`" for row in arguments[name].items() if row in linked)
                lines += [f"[The environment's flags](environments.md): {flags}.", ""] if flags else []
    return "\n".join(lines)


def ours_of(registry: Any) -> dict[str, type]:
    """{type: its config} of what this package registered with LeRobot."""
    register_third_party_plugins()
    known = registry.get_known_choices()
    return {name: each for name, each in sorted(known.items()) if is_ours(each)}


def environments_page() -> str:
    """Every flag of every environment."""
    lines = [
        "# Flags of the environments",
        "",
        "Flags of `lerobot-eval` after `--env.type=NAME`; `lerobot-bomb` commands take them too.",
        "Flags of LeRobot's own (`lerobot-eval --help`) are not listed.",
        "",
    ]
    for env_type, config_class in ours_of(EnvConfig).items():
        rows = [
            [f"`--env.{each.name}`", default_of(each), meaning_of(config_class, each.name)]
            for each in own_fields(config_class)
        ]
        lines += [f"## {env_type}", "", *markdown_table("flag | default | meaning", rows)]
    return "\n".join(lines)


def policies_page() -> str:
    """Every field of every policy's config."""
    types = ours_of(PreTrainedConfig)
    models = {name: each for name, each in types.items() if issubclass(each, VlaConfig)}
    shared = shared_fields(models.values())
    lines = [
        "# Flags of the policies",
        "",
        "Flags of `lerobot-train` after `--policy.type=NAME`, and fields of a checkpoint's `config.json`.",
        "Fields of LeRobot's own (`device`, `repo_id`, ...) are not listed.",
        "",
        "## Shared",
        "",
        "A policy's column holds its defaults. Empty: unset. `-`: the policy has no such flag.",
        "",
    ]
    for title, meanings in shared.items():
        lines += group_table(title, meanings, models)
    for policy_type, config_class in types.items():
        lines += [f"## {policy_type}", ""]
        lines += ["Also [the shared flags](#shared).", ""] if policy_type in models else []
        for title, names in groups_of(config_class).items():
            others = shared[title] if policy_type in models else {}
            own = {each: meaning_of(config_class, each) for each in names if each not in others}
            lines += group_table(title, own, {"default": config_class})
    return "\n".join(lines)


def group_table(title: str, meanings: dict[str, str], types: dict[str, type]) -> list[str]:
    """Lay out fields of a group, with a column of defaults per type; what the code fills in has none."""
    if not meanings:
        return []
    if title == FILLED_IN:
        rows = markdown_table(
            "field | meaning", [[f"`{name}`", meaning] for name, meaning in meanings.items()]
        )
    else:
        rows = markdown_table(
            " | ".join(["flag", *types, "meaning"]),
            [
                [f"`--policy.{name}`", *(default_in(each, name) for each in types.values()), meaning]
                for name, meaning in meanings.items()
            ],
        )
    return [f"**{title}**", "", *rows]


def record_types() -> Sequence[type[Record]]:
    """Return the type of the records of each environment."""
    return [each.record for each in ENVIRONMENTS.values()]


def axes_page() -> str:
    """Every perturbation axis with its levels; those of `bomb` have a page with pictures."""
    lines = [
        "# Perturbation axes of PushT and LIBERO",
        "",
        "What each axis changes at its levels. How conditions are written, and the axes of `bomb`:",
        "[perturbations](../perturbations.md).",
        "",
    ]
    # {text of an axis: the environment that has it first, and the link}
    first = {_axis_text(axis): (BOMB.name, f"../perturbations.md#{name}") for name, axis in AXES.items()}
    for env_type, axes in own_axes().items():
        for name, axis in axes.items():
            own = f"#{env_type}-{name}"
            like, link = first.setdefault(_axis_text(axis), (env_type, own))
            same = [f"Its levels are [those of {like}]({link}).", ""]
            rows = sizes_table(axis) if link == own else same
            lines += [f"## {env_type}: {name}", "", f"{_summary(axis)}{_sheet(env_type, name)}", "", *rows]
    return "\n".join(lines)


def own_axes() -> dict[str, Mapping[str, Axis]]:
    """{env type other than `bomb`: its axes}."""
    types = {each.env_type: each.condition.axes for each in record_types()}
    return {name: axes for name, axes in types.items() if name != BOMB.name}


def _axis_text(axis: Axis) -> str:
    return "\n".join([_summary(axis), *sizes_table(axis)])


def _summary(axis: Axis) -> str:
    return summary_of(axis) + " Not part of `all`: it helps." * axis.is_help


def _sheet(env_type: str, axis: str) -> str:
    path = f"media/{env_type}/{axis}.jpg"
    return f" [Pictures](../{path})." if (FOLDER.parent / path).is_file() else ""


def records_page() -> str:
    """Every field of a record of a results file, by environment."""
    lines = [
        "# Fields of a record",
        "",
        "A results file (`--env.results_path`) has a JSON object, a *record*, for each finished episode: the",
        "fields of its environment, and those [of all environments](#all-environments).",
        "How records are pooled and compared: [protocol](../benchmark.md#records).",
        "",
    ]
    rows = {each: [*map(tuple, record_rows(each))] for each in record_types()}
    shared = [row for row in next(iter(rows.values())) if all(row in each for each in rows.values())]
    alike: dict[tuple, list[type[Record]]] = {}
    for record_type, each in rows.items():
        alike.setdefault(tuple(row for row in each if row not in shared), []).append(record_type)
    for own, types in alike.items():
        versions = ", ".join(f"`{list(each.versions)[-1]}`" for each in types)
        lines += [f"## {', '.join(each.env_type for each in types)}", "", f"Protocol {versions}.", ""]
        lines += markdown_table("field | JSON | meaning", own)
    lines += ["## All environments", "", *markdown_table("field | JSON | meaning", shared)]
    for name, inner in {name: each for types in rows for name, each in nested_in(types).items()}.items():
        lines += [f"## {name}", "", *markdown_table("field | JSON | meaning", _rows(inner, name))]
    return "\n".join(lines)


def field_names(cls: Any) -> list[str]:
    """Return the names of a dataclass's fields."""
    return [each.name for each in dataclasses.fields(cls)]


def nested_in(record_type: type[Record]) -> dict[str, type]:
    """{field of a record that is an object: its type}, without the spec."""
    hints = get_type_hints(record_type, include_extras=True)
    inner = {name: _dataclass_of(hints[name]) for name in field_names(record_type) if name != "spec"}
    return {name: each for name, each in inner.items() if each is not None}


def record_rows(record_type: type[Record]) -> Iterator[list[str]]:
    """Yield the fields of a record."""
    hints, comments = get_type_hints(record_type, include_extras=True), comments_of(record_type)
    nested = nested_in(record_type)
    for name in field_names(record_type):
        if name == "spec":
            yield from _rows(_dataclass_of(hints[name]), name)
        else:
            kind = f"object: [below](#{name}), or null" if name in nested else json_kind(hints[name])
            yield [f"`{name}`", kind, comments.get(name, "")]


def _dataclass_of(hint: Any) -> Any:
    return next(filter(dataclasses.is_dataclass, _members(hint)), None)


def _rows(cls: Any, prefix: str) -> Iterator[list[str]]:
    hints, comments = get_type_hints(cls, include_extras=True), comments_of(cls)
    for name in field_names(cls):
        yield [f"`{prefix}.{name}`", json_kind(hints[name]), comments.get(name, "")]


def _members(hint: Any) -> list[Any]:
    """X | None -> [X, None]; Annotated[X, check] -> those of X."""
    if get_origin(hint) is Annotated:
        return _members(get_args(hint)[0])
    if get_origin(hint) in (Union, UnionType):
        return [member for each in get_args(hint) for member in _members(each)]
    return [hint]


def json_kind(hint: Any) -> str:
    """Name the JSON values of a type: 'whole number or null'."""
    kinds = []
    for member in _members(hint):
        if member is NoneType:
            kinds.append("null")
        elif get_origin(member) is tuple:
            kinds.append("list")
        elif get_origin(member) is dict:
            kinds.append("object")
        else:
            kinds.append(JSON_KINDS[str if isinstance(member, type) and issubclass(member, str) else member])
    return " or ".join(kinds)


def pages() -> dict[str, str]:
    """{file name: its text}."""
    made = {
        "commands.md": commands_page(),
        "environments.md": environments_page(),
        "policies.md": policies_page(),
        "axes.md": axes_page(),
        "records.md": records_page(),
    }
    note = "<!-- Generated from the code by `make reference`. -->\n\n"
    return {name: f"{note}{text.rstrip()}\n" for name, text in made.items()}


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for file_name, page in pages().items():
        (FOLDER / file_name).write_text(page)
