"""Types that LeRobot knows, read from source: importing LeRobot to ask for them takes seconds."""

import importlib.metadata
import pkgutil
import re
from importlib.util import find_spec
from pathlib import Path

OURS = "lerobot_policy_bomb"
PLUGIN = re.compile(r"lerobot_(robot|camera|teleoperator|policy|env)_")  # names that LeRobot imports
# folder of LeRobot's -> its registry, files in that folder, what our packages' names begin with
KINDS = {
    "policies": ("PreTrainedConfig", "*/configuration_*.py", "lerobot_policy_"),
    "envs": ("EnvConfig", "*.py", "lerobot_env_"),
}


def registered_types(kind: str) -> set[str] | None:
    """Return the types of LeRobot and this package, of one of `KINDS`; None: another plugin may add some."""
    registry, pattern, prefix = KINDS[kind]
    names = {str(each.metadata["Name"]) for each in importlib.metadata.distributions()}
    others = {name.lower().replace("-", "_") for name in names} - {OURS}
    spec = find_spec("lerobot")
    if spec is None or not spec.submodule_search_locations or any(map(PLUGIN.match, others)):
        return None
    files = [*Path(spec.submodule_search_locations[0], kind).glob(pattern)]
    for module in pkgutil.iter_modules():
        if module.name.startswith(prefix):
            folder = Path(module.module_finder.path) / module.name  # pyright: ignore
            files += folder.glob("configuration_*.py")
    types = re.compile(rf"""{registry}\.register_subclass\(\s*(?:name=)?["'](\w+)["']""")
    return {name for path in files for name in types.findall(path.read_text())}
