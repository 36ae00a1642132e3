"""Rules of who may import whom; see docs/architecture.md."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SHARED = "lerobot_env_mujoco"  # by environments
PACKAGES = {
    path.name for folder in ("envs", "policies") for path in (ROOT / folder).iterdir() if path.is_dir()
} - {SHARED}
ENTRY = "lerobot_policy_bomb"
POLICY_PREFIX = "lerobot_policy_"
POLICY_TYPES = {name.removeprefix(POLICY_PREFIX) for name in PACKAGES if name.startswith(POLICY_PREFIX)} - {
    ENTRY.removeprefix(POLICY_PREFIX)
}
# commands that are about certain policies
NAMES_POLICIES = {
    "convert_spatialvla.py": {"spatialvla_grid"},  # whose format it writes
    "audit.py": {"bomb_expert", "bomb_random"},  # ceiling and floor
    "demo.py": {"vla0_smol", "bomb_expert", "bomb_random"},  # who plays
}
HEAVY = {"torch", "lerobot", "transformers", "rerun", "cv2"}
NOT_OURS = {"lerobot", "draccus", "argparse", "huggingface_hub", "datasets", "transformers"}
STOCK = "stock.py"  # an environment of LeRobot's, which ours is
CORE = "lerobot_bomb"
# a folder or module of the core imports from those above it in this list
ORDER = [
    "__init__", "compat", "finite", "flag_errors", "flags", "conditions", "stats", "bootstrap",
    "smoothness", "tables", "files", "cuda_graphs",
    "bomb", "pusht", "libero", "results", "envs", "actions", "flow", "vlm", "decoding", "training", "data",
    "checkpoints", "evaluation", "viewing", "explain", "hub", "policies", "serving", "harness", "sweep",
    "report", "commands",
]  # fmt: skip


def imported_modules(path: Path, top_level_only: bool = False) -> set[str]:
    """Return what a file imports, modules and what it takes from them: {"lerobot_bomb.flags.one_of"}."""
    tree = ast.parse(path.read_text())
    nodes = tree.body if top_level_only else ast.walk(tree)
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


def files(*folders: str) -> list[Path]:
    found = [path for folder in folders for path in (ROOT / folder).rglob("*.py")]
    assert found, f"no Python files in {folders}"
    return found


@pytest.mark.parametrize("path", files("lerobot_bomb"), ids=lambda path: str(path.relative_to(ROOT)))
def test_core_imports_no_env_and_no_policy(path: Path) -> None:
    assert not imported(path) & PACKAGES


@pytest.mark.parametrize("path", files(CORE), ids=lambda path: str(path.relative_to(ROOT)))
def test_the_core_names_no_policy(path: Path) -> None:
    named = set(re.findall(rf"\b({'|'.join(POLICY_TYPES)})\b", path.read_text()))
    allowed = NAMES_POLICIES.get(path.name, set()) if path.parent.name == "commands" else set()
    assert named == allowed


def test_the_order_of_the_core_is_complete() -> None:
    there = {
        path.stem
        for path in (ROOT / CORE).iterdir()
        if path.suffix == ".py" or (path / "__init__.py").is_file()
    }
    assert there == set(ORDER) and len(ORDER) == len(there)


@pytest.mark.parametrize("path", files(CORE), ids=lambda path: str(path.relative_to(ROOT)))
def test_the_core_imports_downwards(path: Path) -> None:
    part = path.relative_to(ROOT / CORE).parts[0].removesuffix(".py")
    parts = {name.split(".")[1] for name in imported_modules(path) if name.startswith(f"{CORE}.")}
    allowed = set(ORDER[: ORDER.index(part) + 1])
    assert parts & set(ORDER) <= allowed


def test_only_commands_read_a_command_line() -> None:
    readers = {path.parent.name for path in files(CORE) if "argparse" in imported(path)}
    assert readers == {"commands"}


@pytest.mark.parametrize("path", files("envs"), ids=lambda path: str(path.relative_to(ROOT)))
def test_an_env_imports_no_policy_and_no_other_env(path: Path) -> None:
    own = path.relative_to(ROOT / "envs").parts[0]
    assert not imported(path) & (PACKAGES - {own})


@pytest.mark.parametrize("path", files("policies"), ids=lambda path: str(path.relative_to(ROOT)))
def test_a_policy_imports_no_env_and_no_other_policy(path: Path) -> None:
    own = path.relative_to(ROOT / "policies").parts[0]
    if own != ENTRY:
        assert not imported(path) & (PACKAGES - {own})


def test_the_entry_module_imports_every_env_and_policy() -> None:
    registered = imported(ROOT / "policies" / ENTRY / "__init__.py") & PACKAGES
    assert registered == PACKAGES - {ENTRY}


def test_nothing_imports_the_entry_module() -> None:
    for path in files("lerobot_bomb", "envs", "policies", "benchmarks"):
        assert ENTRY not in imported(path), path


@pytest.mark.parametrize("path", files("envs"), ids=lambda path: str(path.relative_to(ROOT)))
def test_the_simulator_imports_nothing_heavy(path: Path) -> None:
    if path.name.startswith("configuration_") or path.name == STOCK:
        assert "lerobot" in imported(path)
    else:
        assert not imported(path, top_level_only=True) & HEAVY
        assert not imported(path) & (HEAVY - {"cv2"})


@pytest.mark.parametrize(
    "name",
    [
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
        *(f"results/{path.name}" for path in (ROOT / CORE / "results").iterdir() if path.suffix == ".py"),
    ],
)
def test_what_simulator_workers_import_from_the_core_is_light(name: str) -> None:
    assert not imported(ROOT / "lerobot_bomb" / name) & HEAVY


def test_the_recorder_checks_its_flags_before_it_imports_anything_heavy() -> None:
    for name in ("commands/record.py", "data/record.py"):
        assert not imported(ROOT / "lerobot_bomb" / name, top_level_only=True) & HEAVY


def replaced(path: Path) -> set[str]:
    """Attributes of modules and classes of LeRobot, and of what it stands on, that a file assigns to."""
    tree = ast.parse(path.read_text())
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


@pytest.mark.parametrize(
    "path", files(CORE, "envs", "policies"), ids=lambda path: str(path.relative_to(ROOT))
)
def test_only_compat_replaces_what_is_lerobots(path: Path) -> None:
    if path.relative_to(ROOT).parts[:2] != (CORE, "compat"):
        assert not replaced(path)


def test_what_is_replaced_is_found() -> None:
    found = set().union(*(replaced(path) for path in files("lerobot_bomb/compat")))
    assert {"sys.excepthook", "dataset_writer.compute_episode_stats", "lerobot_eval."} <= found
