"""LIBERO's files, checked without importing LIBERO: its import asks a question, and its use downloads.

hf-libero 0.1.4 reads $LIBERO_CONFIG_PATH/config.yaml (default: ~/.libero), which names the folders of its
tasks and initial states. Without that file, `import libero.libero` asks on the standard input, and fails if
that is closed. Meshes and textures are not in the package, and the file's key `assets` does not count. They
are read from the package's own folder `assets`, or else from ~/.cache/libero/assets. The first environment
downloads them there from the Hub, unless four folders exist. So an interrupted download is never finished;
`missing_assets` names what is missing.
"""

import importlib.util
import os
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from lerobot_bomb.files import written_whole

SUITES = ("libero_spatial", "libero_object", "libero_goal", "libero_10", "libero_90")
INSTALL = "pip install 'lerobot[libero]'"
CONFIG_FILE = "config.yaml"
# the keys of config.yaml that an environment reads
TASK_FOLDERS = ("bddl_files", "init_states")
# folders that hf-libero takes for a finished download
OBJECT_FOLDERS = (
    "articulated_objects",
    "stable_scanned_objects",
    "turbosquid_objects",
    "stable_hope_objects",
)
ASSET_FOLDERS = (*OBJECT_FOLDERS, "scenes", "textures")
# the problem that a task's file names -> the scene that hf-libero's class of this problem loads
SCENES = {
    "LIBERO_Tabletop_Manipulation": "libero_tabletop_base_style",
    "LIBERO_Floor_Manipulation": "libero_floor_base_style",
    "LIBERO_Kitchen_Tabletop_Manipulation": "libero_kitchen_tabletop_base_style",
    "LIBERO_Living_Room_Tabletop_Manipulation": "libero_living_room_tabletop_base_style",
    "LIBERO_Study_Tabletop_Manipulation": "libero_study_base_style",
}
# fixtures that are part of a scene
SCENE_FIXTURES = {"table", "kitchen_table", "living_room_table", "study_table", "floor"}
MAX_NAMED = 5  # missing files in a message


@dataclass(frozen=True)
class Libero:
    """An installed LIBERO."""

    package: Path  # the folder libero/libero

    @classmethod
    def find(cls) -> "Libero | None":
        """Find the LIBERO of this Python; None if not installed."""
        spec = importlib.util.find_spec("libero")
        for folder in (spec and spec.submodule_search_locations) or []:
            if (Path(folder) / "libero" / "__init__.py").is_file():
                return cls(Path(folder) / "libero")
        return None

    @property
    def config_file(self) -> Path:
        """Path of hf-libero's config; a ~ in the environment variable is not expanded."""
        folder = os.environ.get("LIBERO_CONFIG_PATH", os.path.expanduser("~/.libero"))
        return Path(folder) / CONFIG_FILE

    @property
    def assets(self) -> Path:
        """Folder in which hf-libero looks for meshes and textures, and to which it downloads them."""
        own = self.package / "assets"
        return own if own.exists() else Path(os.path.expanduser("~")) / ".cache" / "libero" / "assets"

    def write_config(self) -> None:
        """Write the config file that hf-libero writes after its question, unless there is one.

        Raises:
            ValueError: the file cannot be written; names it and the way out.
        """
        import yaml

        if self.config_file.exists():
            return
        values = {
            "benchmark_root": self.package,
            "bddl_files": self.package / "bddl_files",
            "init_states": self.package / "init_files",
            "datasets": self.package.parent / "datasets",
            "assets": self.assets,
        }
        try:
            with written_whole(self.config_file) as (unfinished,):
                unfinished.write_text(yaml.safe_dump({name: str(path) for name, path in values.items()}))
        except OSError as error:
            raise ValueError(
                f"LIBERO's {self.config_file} cannot be written ({error}); set LIBERO_CONFIG_PATH to a "
                "folder that can be"
            ) from error

    def task_folders(self) -> dict[str, Path]:
        """Return {name in the config file: folder} of task files and initial states; all exist.

        Raises:
            ValueError: there is no config file, it is malformed, or it names a missing folder.
        """
        values, new = self._config(), "delete the file, or set LIBERO_CONFIG_PATH to another folder"
        folders = {}
        for name in TASK_FOLDERS:
            folder = Path(str(values.get(name)))
            if name not in values or not folder.is_dir():
                what = f"names {name}: {folder}, which is no folder" if name in values else f"has no {name}"
                raise ValueError(f"LIBERO's {self.config_file} {what}; {new}: then it is written anew")
            folders[name] = folder
        return folders

    def _config(self) -> dict[str, Any]:
        import yaml

        if not self.config_file.is_file():
            raise ValueError(
                f"LIBERO has no {self.config_file}, and asks on the standard input when it is imported; to "
                "have it written: echo n | python -c 'import libero.libero'"
            )
        try:
            values = yaml.safe_load(self.config_file.read_text())
        except (yaml.YAMLError, OSError, UnicodeDecodeError) as error:
            raise ValueError(f"LIBERO's {self.config_file} cannot be read ({error}); delete it") from error
        if not isinstance(values, dict):
            raise ValueError(f"LIBERO's {self.config_file} is empty or no mapping; delete it")
        return values

    def missing_assets(self, suites: Iterable[str] = SUITES) -> list[str]:
        """Return the folders and files below `assets` that the tasks of these suites lack, sorted.

        Texture files are not checked: hf-libero replaces some by others.

        Raises:
            ValueError: the config file is wrong, or its folders lack a suite.
        """
        absent = [name for name in ASSET_FOLDERS if not (self.assets / name).is_dir()]
        if absent:
            return sorted(absent)
        root = self.task_folders()["bddl_files"]
        missing: set[str] = set()
        for suite in suites:
            tasks = sorted((root / suite).glob("*.bddl"))
            if not tasks:
                raise ValueError(
                    f"{root} has no tasks of {suite}: LIBERO's {self.config_file} is of another version; "
                    "delete it, or set LIBERO_CONFIG_PATH to another folder: then it is written anew"
                )
            for task in tasks:
                missing |= self._missing_of(task.read_text())
        return sorted(missing)

    def _missing_of(self, task: str) -> set[str]:
        """Return the files that a task, given as the text of its file, lacks."""
        problem = re.search(r"\(problem\s+(\w+)\)", task)
        scene = SCENES.get(problem[1]) if problem else None
        files = [self._object_file(name) for name in _object_names(task) - SCENE_FIXTURES]
        files += [self.assets / "scenes" / f"{scene}.xml"] if scene else []
        missing = [path for file in files for path in _missing_with_meshes(file)]
        return {path.relative_to(self.assets).as_posix() for path in missing}

    def _object_file(self, name: str) -> Path:
        """Return the path of an object's model in one of four folders; if it is in none, `*/NAME.xml`."""
        articulated, *others = OBJECT_FOLDERS
        places = [self.assets / articulated / f"{name}.xml"]
        places += [self.assets / folder / name / f"{name}.xml" for folder in others]
        return next((place for place in places if place.is_file()), self.assets / f"*/{name}.xml")


def prepare_libero(suites: Iterable[str] = SUITES) -> Libero:
    """Make sure that LIBERO can be imported and its suites built: without a question, without a download.

    Write the config file if there is none. Call it before `libero` is imported, in every process.

    Raises:
        ValueError: LIBERO is not installed, or its config file or assets are missing, partly missing or of
            another version; names the folder and the way out.
    """
    libero = Libero.find()
    if libero is None:
        raise ValueError(f"LIBERO is not installed: {INSTALL}")
    libero.write_config()
    libero.task_folders()
    missing = libero.missing_assets(suites)
    if missing:
        raise ValueError(describe_missing_assets(libero.assets, missing))
    return libero


def describe_missing_assets(assets: Path, missing: list[str]) -> str:
    """Describe in a line what is missing below a folder of assets, and how to get it."""
    way_out = f"hf download lerobot/libero-assets --repo-type=dataset --local-dir={assets}"
    if not assets.exists():
        return f"LIBERO's assets are missing, {assets} does not exist: {way_out}"
    named = ", ".join(missing[:MAX_NAMED]) + (", ..." if len(missing) > MAX_NAMED else "")
    return (
        f"LIBERO's assets in {assets} are not whole or of another version: {len(missing)} missing ({named}); "
        f"{way_out}"
    )


def _object_names(task: str) -> set[str]:
    """Return the kinds of objects and fixtures that a task's file names: `a_1 a_2 - kind`."""
    sections = re.findall(r"\(:(?:objects|fixtures)\b(.*?)\)", task, re.DOTALL)
    return {name for section in sections for name in re.findall(r"-\s+(\S+)", section)}


def _missing_with_meshes(file: Path) -> list[Path]:
    """Return a model's file if it is missing or damaged, else the missing meshes that it names."""
    if not file.is_file():
        return [file]
    try:
        meshes = [mesh.get("file", "") for mesh in ElementTree.parse(file).iter("mesh")]
    except ElementTree.ParseError:
        return [file]
    return [file.parent / mesh for mesh in meshes if mesh and not (file.parent / mesh).is_file()]
