"""Write the pages of docs/reference/ from the code: commands, flags, config fields, axes, fields of records.

``make reference`` runs it; tests/test_reference.py compares the committed pages with what it would write.
"""

import dataclasses
from argparse import SUPPRESS, Action
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

from config_fields import comments_of, default_of, is_ours, own_fields
from lerobot.configs import PreTrainedConfig
from lerobot.envs import EnvConfig
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_bomb.commands.main import Parser, command_parser
from lerobot_bomb.commands.table import COMMANDS, PROGRAM
from lerobot_bomb.conditions import MAX_LEVEL, Axis
from lerobot_bomb.environments import ENVIRONMENTS
from lerobot_bomb.policies.flag_groups import flags_of
from lerobot_bomb.results.record import Record, field_names

FOLDER = Path(__file__).parent / "reference"
JSON_KINDS = {bool: "true or false", int: "whole number", float: "number", str: "text", Any: "any"}


def table(header: str, rows: Iterable[Iterable[str]]) -> list[str]:
    """Lay out rows of cells under a header, `a | b`, as Markdown."""
    rule = "---|" * len(header.split("|"))
    cells = (" | ".join(cell.replace("|", "\\|") for cell in row) for row in rows)
    return [f"| {header} |", f"|{rule}", *(f"| {row} |" for row in cells), ""]


def flag_rows(config_class: type, names: Iterable[str], prefix: str) -> Iterator[list[str]]:
    """Yield flag, default and explanation of fields of a config."""
    comments, choices = comments_of(config_class), getattr(config_class, "CHOICES", {})
    fields = {each.name: each for each in dataclasses.fields(config_class)}
    for name in names:
        meaning, allowed = comments.get(name, ""), [*map(str, choices.get(name, ()))]
        meaning += "" if all(each in meaning for each in allowed) else f" ({', '.join(allowed)})"
        yield [f"`--{prefix}.{name}`", default_of(fields[name]), meaning]


def argument_rows(parser: Parser) -> Iterator[list[str]]:
    """Yield the arguments of a command, each with its explanation."""
    formatter = parser._get_formatter()
    for action in parser._actions:
        if action.dest != "help" and action.help != SUPPRESS:
            is_required = " (required)" * bool(action.required and action.option_strings)
            yield [_spelling(action), f"{formatter._expand_help(action)}{is_required}"]


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
    for group in dict.fromkeys(command.group for command in COMMANDS.values()):
        lines += [f"## {group}", ""]
        for name, command in COMMANDS.items():
            if command.group == group:
                examples = [f"{PROGRAM} {name} {flags}".rstrip() for flags in command.examples]
                summary = f"{command.summary[0].upper()}{command.summary[1:]}."
                lines += [f"### {name}", "", summary, "", "```", *examples, "```", ""]
                rows = [*argument_rows(command_parser(name))]
                lines += table("argument | meaning", rows) if rows else []
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
    for name, config_class in ours_of(EnvConfig).items():
        names = [each.name for each in own_fields(config_class)]
        lines += [f"## {name}", ""]
        lines += table("flag | default | meaning", flag_rows(config_class, names, "env"))
    return "\n".join(lines)


def policies_page() -> str:
    """Every field of every policy's config."""
    lines = [
        "# Flags of the policies",
        "",
        "Flags of `lerobot-train` after `--policy.type=NAME`, and fields of a checkpoint's `config.json`.",
        "Fields of LeRobot's own (`device`, `repo_id`, ...) are not listed.",
        "",
    ]
    for name, config_class in ours_of(PreTrainedConfig).items():
        names = [each.name for each in own_fields(config_class)]
        research, filled_in = (flags_of(config_class, group) for group in ("RESEARCH", "FILLED_IN"))
        groups = {
            "Listed by `--help`": [each for each in names if each not in {*research, *filled_in}],
            "For research, not in `--help`": [each for each in names if each in research],
        }
        lines += [f"## {name}", ""]
        for title, members in groups.items():
            if members:
                rows = flag_rows(config_class, members, "policy")
                lines += [f"**{title}**", "", *table("flag | default | meaning", rows)]
        comments = comments_of(config_class)
        rows = [[f"`{each}`", comments.get(each, "")] for each in names if each in filled_in]
        lines += ["**Filled in by the code**", "", *table("field | meaning", rows)] if rows else []
    return "\n".join(lines)


def record_types() -> Sequence[type[Record]]:
    """Return the type of the records of each environment."""
    return [each.record for each in ENVIRONMENTS.values()]


def axes_page() -> str:
    """Every perturbation axis with its levels."""
    levels = " | ".join(map(str, range(1, MAX_LEVEL + 1)))
    lines = [
        "# Perturbation axes",
        "",
        "What each axis changes at its levels. How conditions are written, with pictures:",
        "[perturbations](../perturbations.md).",
        "",
    ]
    for record_type in record_types():
        for name, axis in record_type.condition.axes.items():
            lines += [f"## {record_type.env_type}: {name}", "", *_axis(axis)]
            lines += table(f"quantity | {levels} | unit | meaning", _magnitudes(axis))
            lines += _sheet(record_type.env_type, name)
    return "\n".join(lines)


def _axis(axis: Axis) -> list[str]:
    summary = f"{axis.summary[0].upper()}{axis.summary[1:]}. Changes: {', '.join(axis.changes)}."
    return [summary + " Not part of `all`: it helps." * axis.is_help, ""]


def _magnitudes(axis: Axis) -> Iterator[list[str]]:
    for quantity, size in axis.magnitudes.items():
        yield [quantity, *(f"{value:g}" for value in size.levels), size.unit, size.what]


def _sheet(env_type: str, axis: str) -> list[str]:
    folder = "perturbations" if env_type == "bomb" else env_type
    path = f"media/{folder}/{axis}.jpg"
    return [f"[Its pictures](../{path})", ""] if (FOLDER.parent / path).is_file() else []


def records_page() -> str:
    """Every field of a record of a results file, by environment."""
    lines = [
        "# Fields of a record",
        "",
        "A results file (`--env.results_path`) has a JSON object, a *record*, for each finished episode.",
        "How records are pooled and compared: [protocol](../benchmark.md#records).",
        "",
    ]
    nested: dict[str, type] = {}
    for record_type in record_types():
        version = list(record_type.versions)[-1]
        lines += [f"## {record_type.env_type}", "", f"Protocol `{version}`.", ""]
        lines += table("field | JSON | meaning", record_rows(record_type, nested))
    for name, shared in nested.items():
        lines += [f"## {name}", "", *table("field | JSON | meaning", _rows(shared, name))]
    return "\n".join(lines)


def record_rows(record_type: type[Record], nested: dict[str, type]) -> Iterator[list[str]]:
    """Yield the fields of a record; objects that all environments share are put into `nested`."""
    hints, comments = get_type_hints(record_type, include_extras=True), comments_of(record_type)
    for name in field_names(record_type):
        inner = next(filter(dataclasses.is_dataclass, _members(hints[name])), None)
        if inner is not None and name != "spec":
            nested[name] = inner  # pyright: ignore[reportArgumentType]
            kind = f"object: [below](#{name}), or null"
            yield [f"`{name}`", kind, comments.get(name, "")]
        elif inner is not None:
            yield from _rows(inner, name)
        else:
            yield [f"`{name}`", json_kind(hints[name]), comments.get(name, "")]


def _rows(cls: Any, prefix: str) -> Iterator[list[str]]:
    hints, comments = get_type_hints(cls, include_extras=True), comments_of(cls)
    for each in dataclasses.fields(cls):
        yield [f"`{prefix}.{each.name}`", json_kind(hints[each.name]), comments.get(each.name, "")]


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
