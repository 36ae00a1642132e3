"""Presets: config files for `lerobot-train` and `lerobot-eval`, which come with the package."""

from pathlib import Path

SUFFIX = ".yaml"
_INSTALLED = Path(__file__).parent / "configs"  # pyproject.toml puts them there in a wheel
FOLDER = _INSTALLED if _INSTALLED.is_dir() else Path(__file__).parents[1] / "configs"


def preset_names() -> list[str]:
    """Return the names of all presets, such as `train_fdvla_bomb` or `ablations/fdvla_flow_only`."""
    return sorted(str(path.relative_to(FOLDER).with_suffix("")) for path in FOLDER.rglob(f"*{SUFFIX}"))


def preset_path(name: str) -> Path:
    """Return a preset's file.

    Raises:
        ValueError: there is none of this name.
    """
    if name not in preset_names():
        raise ValueError(f"there is no preset {name!r}; `lerobot-bomb config` lists all")
    return FOLDER / f"{name}{SUFFIX}"
