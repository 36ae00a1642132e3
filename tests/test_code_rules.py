"""Rules of style that no linter has."""

import ast
import re
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDERS = ("lerobot_bomb", "policies", "envs", "benchmarks", "tests")
FRAGMENT = re.compile(
    r"(All|Also|Around|As|At|Between|Both|By|For|From|How|In|None|Of|On|Only|So|That|The same|Their|These|"
    r"Those|Unless|Until|What|Where|Whether|Which|Who|Whose|With)\b"
)


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@cache
def nodes_of(path: Path) -> list[ast.AST]:
    return list(ast.walk(parsed(path)))


def test_no_docstring_opens_with_a_fragment() -> None:
    """Check that each starts with a verb or a noun phrase, which a stranger understands alone."""
    fragments, num_docstrings = [], 0
    for path in (path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")):
        for node in nodes_of(path):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef | ast.Module):
                docstring = ast.get_docstring(node)
                num_docstrings += docstring is not None
                if docstring and FRAGMENT.match(docstring):
                    fragments.append(f"{path.relative_to(ROOT)}: {docstring.splitlines()[0]}")
    assert num_docstrings > 1000 and not fragments


# names that have one role in each module of a kind: a command, a section of a report, a policy's parts
FAMILIES = {"add_arguments": "/commands/", "run": "/commands/", "section": "/report/sections/"}
FAMILIES |= {"build_model": "/building_", "make_layout": "/building_", "make_pointer": "/pointing_"}


def test_no_two_public_classes_or_functions_have_one_name() -> None:
    places: dict[str, set[str]] = {}
    for path in (path for folder in FOLDERS[:3] for path in (ROOT / folder).rglob("*.py")):
        for node in parsed(path).body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                kind = FAMILIES.get(node.name)
                place = kind if kind and kind in str(path) else str(path.relative_to(ROOT))
                places.setdefault(node.name, set()).add(place)
    assert len(places) > 1000 and not {name: each for name, each in places.items() if len(each) > 1}


def test_scores_of_a_policy_reach_into_none_of_its_private_members() -> None:
    paths = [*(ROOT / "lerobot_bomb" / "explain").glob("*.py"), *(ROOT / "policies").glob("*/scored_*.py")]
    reached = [
        f"{path.relative_to(ROOT)}: {ast.unparse(node)}"
        for path in paths
        for node in nodes_of(path)
        if isinstance(node, ast.Attribute)
        and re.match(r"_(?!_)", node.attr)
        and ast.unparse(node.value) != "self"
    ]
    assert len(paths) > 20 and not reached


def test_no_variable_or_parameter_is_named_of() -> None:
    """Check that each has a name that says what it holds."""
    places, num_names = [], 0
    for path in (path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")):
        for node in nodes_of(path):
            if isinstance(node, ast.Name | ast.arg):
                num_names += 1
                if (node.id if isinstance(node, ast.Name) else node.arg) == "of":
                    places.append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert num_names > 10_000 and not places
