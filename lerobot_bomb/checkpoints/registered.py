"""Types that LeRobot knows, read from source: importing LeRobot to ask for them takes seconds."""

import importlib.metadata
import pkgutil
import re
from importlib.util import find_spec
from pathlib import Path

PLUGIN = re.compile(r"lerobot_(robot|camera|teleoperator|policy|env)_")  # names that LeRobot imports
# folder of LeRobot's -> its registry, and files in that folder
KINDS = {"policies": ("PreTrainedConfig", "*/configuration_*.py"), "envs": ("EnvConfig", "*.py")}


def registered_types(kind: str) -> set[str] | None:
    """Return the types of one of `KINDS` in LeRobot and its plugins; None if source does not show all."""
    registry, pattern = KINDS[kind]
    spec = find_spec("lerobot")
    plugins = {
        module.name: Path(module.module_finder.path, module.name)  # pyright: ignore
        for module in pkgutil.iter_modules()
        if PLUGIN.match(module.name)
    }
    installed = {str(each.metadata["Name"]) for each in importlib.metadata.distributions()}
    is_any_hidden = {name for name in installed if PLUGIN.match(name)} - plugins.keys()
    if spec is None or not spec.submodule_search_locations or is_any_hidden:
        return None
    files = [*Path(spec.submodule_search_locations[0], kind).glob(pattern)]
    files += [path for folder in plugins.values() for path in folder.rglob("*.py")]
    types = re.compile(rf"""{registry}\.register_subclass\(\s*(?:name=)?(?:["'](\w+)["'])?""")
    found = {name for path in files for name in types.findall(path.read_text())}
    return None if "" in found else found
