"""Version that wrote a checkpoint's config.json, and the reasons not to read one."""

from collections.abc import Sequence
from pathlib import Path

import draccus
from draccus.utils import DecodingError
from packaging.version import Version

from lerobot_bomb import __version__
from lerobot_bomb.checkpoints.names import CONFIG, local_file
from lerobot_bomb.compat.use import use
from lerobot_bomb.files import read_json

MAX_SHOWN = 60  # characters


class PackageVersion(str):
    """Version in a config: reading gives the installed version, or an error if the config is newer.

    Releases that differ only in the third number read each other's checkpoints.
    """


INSTALLED = PackageVersion(__version__)


@draccus.decode.register(PackageVersion)
def _decode(written_by: str, path: Sequence[str]) -> PackageVersion:
    """Return the installed version, with which the config would be written next.

    Raises:
        DecodingError: the checkpoint is newer, so its fields and weights may mean something else.
    """
    use()
    if Version(written_by).release[:2] > Version(__version__).release[:2]:
        raise DecodingError(
            path,
            f"this checkpoint was written by lerobot_bomb {written_by}, newer than the installed "
            f"{__version__}: update lerobot_bomb",
        )
    return INSTALLED


draccus.encode.register(PackageVersion, str)


def config_damage(pretrained: str | Path, revision: str | None) -> str | None:
    """Return why a config.json is not a policy's; None if it is, or if there is no file."""
    try:
        file = local_file(pretrained, revision, CONFIG)
        policy_type = None if file is None else read_json(file).get("type")
    except ValueError as error:
        return str(error)
    if policy_type is None or isinstance(policy_type, str):
        return None
    return f"its type is {str(policy_type)[:MAX_SHOWN]}, not the name of a policy type"
