"""Policy types that LeRobot knows, read from source: importing LeRobot to ask for them takes seconds."""

import importlib.metadata
import pkgutil
import re
from importlib.util import find_spec
from pathlib import Path

OURS = "lerobot_policy_bomb"
PLUGIN = re.compile(r"lerobot_(robot|camera|teleoperator|policy|env)_")  # names that LeRobot imports
TYPE = re.compile(r"""PreTrainedConfig\.register_subclass\(\s*(?:name=)?["'](\w+)["']""")


def registered_policy_types() -> set[str] | None:
    """Return the types of LeRobot and of this package; None where another plugin may add some."""
    names = {name.lower().replace("-", "_") for name in _distributions()}
    spec = find_spec("lerobot")
    if spec is None or not spec.submodule_search_locations or any(map(PLUGIN.match, names - {OURS})):
        return None
    folders = [*Path(spec.submodule_search_locations[0], "policies").iterdir()]
    for module in pkgutil.iter_modules():
        if module.name.startswith("lerobot_policy_"):
            folders.append(Path(module.module_finder.path) / module.name)  # pyright: ignore
    files = [path for folder in folders for path in folder.glob("configuration_*.py")]
    return {name for path in files for name in TYPE.findall(path.read_text())}


def _distributions() -> list[str]:
    return [str(each.metadata["Name"]) for each in importlib.metadata.distributions()]
