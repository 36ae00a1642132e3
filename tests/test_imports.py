"""Rules of who may import whom; see docs/architecture.md."""

import ast
import re
from collections.abc import Iterable
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
ENVS, POLICIES = "lerobot_env_bomb", "lerobot_policy_bomb"
FOLDERS = {ENVS: ROOT / "envs" / ENVS, POLICIES: ROOT / "policies" / POLICIES}
SHARED = f"{ENVS}.shared"  # by environments
# an environment or a policy type each: "lerobot_env_bomb.pusht"
PACKAGES = {
    f"{name}.{path.parent.name}" for name, folder in FOLDERS.items() for path in folder.glob("*/__init__.py")
} - {SHARED}
POLICY_TYPES = {name.partition(".")[2] for name in PACKAGES if name.startswith(POLICIES)}
# what is about certain policies
NAMES_POLICIES = {
    "checkpoints/spatialvla_folder.py": {"spatialvla_grid"},  # whose format it writes
    "commands/audit.py": {"bomb_expert", "bomb_random"},  # ceiling and floor
    "commands/demo.py": {"bomb_expert"},  # ceiling of the demo's table
    "commands/table.py": {"vla0_smol", "fdvla", "bomb_expert"},  # examples of commands
}
HEAVY = {"torch", "lerobot", "transformers", "rerun", "cv2"}
NOT_OURS = {"lerobot", "draccus", "argparse", "huggingface_hub", "datasets", "transformers"}
STOCK = "stock.py"  # an environment of LeRobot's, which ours is
CORE = "lerobot_bomb"
# a folder or module of the core imports from those above it in this list
ORDER = [
    "__init__", "registry", "compat", "finite", "flag_errors", "flags", "conditions", "failures",
    "environments", "stats", "bootstrap", "smoothness", "tables", "files", "presets", "cuda_graphs",
    "bomb", "pusht", "libero", "results", "envs", "actions", "flow", "vlm", "decoding", "training", "data",
    "checkpoints", "evaluation", "viewing", "explain", "report", "hub", "policies", "serving", "harness",
    "inspect_robots", "sweep", "commands",
]  # fmt: skip


# what LeRobot and torch take seconds for must not be imported by what simulator workers import
LIGHT = (
    "bomb/board.py",
    "bomb/episode.py",
    "bomb/observation.py",
    "bomb/expert.py",
    "envs/episode_env.py",
    "envs/perturbation.py",
    "pusht/episode.py",
    "libero/assets.py",
    "envs/vector.py",
    "files.py",
    "stats.py",
    "bootstrap.py",
    "smoothness.py",
    "data/rollout_pool.py",
    "envs/rollout.py",
    "data/recording.py",
    *(f"results/{path.name}" for path in (ROOT / CORE / "results").glob("*.py")),
)


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@cache
def imported_modules(path: Path, top_level_only: bool = False) -> set[str]:
    """Return what a file imports, modules and what it takes from them: {"lerobot_bomb.flags.one_of"}."""
    nodes = parsed(path).body if top_level_only else ast.walk(parsed(path))
    names = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def imported(path: Path, top_level_only: bool = False) -> set[str]:
    """The top-level packages of the modules that a file imports."""
    return {name.split(".")[0] for name in imported_modules(path, top_level_only)}


def imported_packages(path: Path) -> set[str]:
    """The environments and policies among what a file imports."""
    return {".".join(name.split(".")[:2]) for name in imported_modules(path)} & PACKAGES


def files(*folders: str) -> list[Path]:
    found = [path for folder in folders for path in sorted((ROOT / folder).rglob("*.py"))]
    assert found, f"no Python files in {folders}"
    return found


def require_none(what: str, found: Iterable[tuple[Path, set[str]]]) -> None:
    """Fail with every file that breaks a rule, and how."""
    lines = [f"{path.relative_to(ROOT)}: {', '.join(sorted(names))}" for path, names in found if names]
    assert not lines, "\n".join([what, *lines])


def test_core_imports_no_env_and_no_policy() -> None:
    found = ((path, imported(path) & FOLDERS.keys()) for path in files(CORE))
    require_none("the core imports environments or policies", found)


def policies_named_wrongly(path: Path) -> set[str]:
    named = set(re.findall(rf"\b({'|'.join(POLICY_TYPES)})\b", path.read_text()))
    return named ^ NAMES_POLICIES.get(str(path.relative_to(ROOT / CORE)), set())


def test_the_core_names_no_policy() -> None:
    require_none(
        "the core names policies, or no more those of NAMES_POLICIES",
        ((path, policies_named_wrongly(path)) for path in files(CORE)),
    )


def test_the_order_of_the_core_is_complete() -> None:
    there = {
        path.stem
        for path in (ROOT / CORE).iterdir()
        if path.suffix == ".py" or (path / "__init__.py").is_file()
    }
    assert there == set(ORDER) and len(ORDER) == len(there)


def imported_from_above(path: Path) -> set[str]:
    part = path.relative_to(ROOT / CORE).parts[0].removesuffix(".py")
    parts = {name.split(".")[1] for name in imported_modules(path) if name.startswith(f"{CORE}.")}
    return parts & set(ORDER[ORDER.index(part) + 1 :])


def test_the_core_imports_downwards() -> None:
    found = ((path, imported_from_above(path)) for path in files(CORE))
    require_none("folders of the core import from those above them", found)


def test_only_commands_read_a_command_line() -> None:
    readers = {path.parent.name for path in files(CORE) if "argparse" in imported(path)}
    assert readers == {"commands", "compat"}  # compat/help.py takes a mark of argparse


def test_envs_and_policies_import_none_but_their_own() -> None:
    for name in FOLDERS:
        for package in (each for each in PACKAGES if each.startswith(name)):
            own = sorted((FOLDERS[name] / package.partition(".")[2]).rglob("*.py"))
            found = ((path, imported_packages(path) - {package}) for path in own)
            require_none(f"{package} imports other environments or policies", found)


def test_the_plugin_imports_every_env_and_policy() -> None:
    assert imported_packages(FOLDERS[POLICIES] / "__init__.py") == PACKAGES


def test_what_environments_share_imports_none() -> None:
    shared = sorted((FOLDERS[ENVS] / "shared").rglob("*.py"))
    require_none(f"{SHARED} imports environments", ((path, imported_packages(path)) for path in shared))


def heavy_imports(path: Path) -> set[str]:
    return imported(path, top_level_only=True) & HEAVY | imported(path) & (HEAVY - {"cv2"})


def test_the_simulator_imports_nothing_heavy() -> None:
    ours = files("envs")
    lerobots = [path for path in ours if path.name.startswith("configuration_") or path.name == STOCK]
    assert [path for path in lerobots if "lerobot" not in imported(path)] == []
    found = ((path, heavy_imports(path)) for path in ours if path not in lerobots)
    require_none("the simulator imports what takes seconds", found)


def test_what_simulator_workers_import_is_light() -> None:
    found = ((ROOT / CORE / name, imported(ROOT / CORE / name) & HEAVY) for name in LIGHT)
    require_none("simulator workers import what takes seconds", found)


def found_with(path: Path, seen: set[Path]) -> set[str]:
    """Return the top-level packages that are imported with a file, by it and by what of ours it imports."""
    found = set[str]()
    for name in imported_modules(path, top_level_only=True):
        found.add(name.split(".")[0])
        for file in (ROOT / f"{name.replace('.', '/')}.py", ROOT / name.replace(".", "/") / "__init__.py"):
            if file.is_file() and file not in seen:
                seen.add(file)
                found |= found_with(file, seen)
    return found


def test_a_command_reads_its_flags_before_anything_heavy_is_imported() -> None:
    found = ((path, found_with(path, {path}) & HEAVY) for path in files("lerobot_bomb/commands"))
    require_none("commands import what takes seconds before they have read their flags", found)
    assert "lerobot" in found_with(ROOT / "lerobot_bomb/viewing/checkpoint.py", set())


def replaced(path: Path) -> set[str]:
    """Attributes of modules and classes of LeRobot, and of what it stands on, that a file assigns to."""
    tree = parsed(path)
    theirs = set()
    for node in ast.walk(tree):
        for alias in node.names if isinstance(node, ast.Import | ast.ImportFrom) else ():
            module = node.module if isinstance(node, ast.ImportFrom) else alias.name
            if (module or "").split(".")[0] in NOT_OURS:
                theirs.add(alias.asname or alias.name.split(".")[0])
    found = set()
    for node in ast.walk(tree):
        targets = node.targets if isinstance(node, ast.Assign) else []
        found |= {ast.unparse(each) for each in targets if isinstance(each, ast.Attribute | ast.Subscript)}
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "setattr":
            found.add(ast.unparse(node.args[0]) + ".")
    return {text for text in found if re.split(r"[.\[]", text)[0] in theirs or text == "sys.excepthook"}


def test_only_compat_replaces_what_is_lerobots() -> None:
    ours = [
        path
        for path in files(CORE, "envs", "policies")
        if path.relative_to(ROOT).parts[:2] != (CORE, "compat")
    ]
    require_none("files replace what is LeRobot's", ((path, replaced(path)) for path in ours))


def test_what_is_replaced_is_found() -> None:
    found = set().union(*(replaced(path) for path in files("lerobot_bomb/compat")))
    assert {"sys.excepthook", "dataset_writer.compute_episode_stats", "lerobot_eval."} <= found
