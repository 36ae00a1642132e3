"""Which version wrote a checkpoint's config.json; one of a newer release is not read."""

from collections.abc import Sequence

import draccus
from draccus.utils import DecodingError
from packaging.version import Version

from lerobot_bomb import __version__
from lerobot_bomb.compat.use import use


class PackageVersion(str):
    """A config's field of this type is the installed version; reading one of a newer release is an error.

    Releases that differ in the third number only read each other's checkpoints.
    """


INSTALLED = PackageVersion(__version__)


@draccus.decode.register(PackageVersion)
def _decode(written_by: str, path: Sequence[str]) -> PackageVersion:
    """The installed version, as that is what writes the config the next time.

    Raises:
        DecodingError: the checkpoint is newer; its fields and weights may mean what nobody here knows.
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
