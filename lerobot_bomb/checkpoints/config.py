"""A checkpoint's config.json that cannot be read here: which version wrote it, and one line that says why."""

import sys
from collections.abc import Sequence
from functools import wraps
from pathlib import Path
from types import TracebackType
from typing import Any

import draccus
from draccus.utils import DecodingError
from huggingface_hub.errors import LocalEntryNotFoundError
from lerobot.configs import PreTrainedConfig
from packaging.version import Version

from lerobot_bomb import __version__
from lerobot_bomb.checkpoints.names import CONFIG, is_hub_id, local_file
from lerobot_bomb.files import read_json

MAX_SHOWN = 60  # characters


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
    if Version(written_by).release[:2] > Version(__version__).release[:2]:
        raise DecodingError(
            path,
            f"this checkpoint was written by lerobot_bomb {written_by}, newer than the installed "
            f"{__version__}: update lerobot_bomb",
        )
    return INSTALLED


draccus.encode.register(PackageVersion, str)


def _damage(file: Path | None) -> str | None:
    """Say what keeps a config.json from being any policy's; None: nothing, or there is none."""
    try:
        policy_type = None if file is None else read_json(file).get("type")
    except ValueError as error:
        return str(error)
    if policy_type is None or isinstance(policy_type, str):
        return None
    return f"its type is {str(policy_type)[:MAX_SHOWN]}, not the name of a policy type"


def tell_config_errors() -> None:
    """Let LeRobot's commands say in one line why they cannot read a config.

    Their parser prints DecodingErrors, and turns others into `Couldn't instantiate class EvalPipelineConfig`.
    lerobot-train reads a checkpoint's config only after it: Python then shows what nobody catches.
    """
    usual: Any = PreTrainedConfig.from_pretrained

    @wraps(usual)
    def from_pretrained(
        cls: type[PreTrainedConfig], pretrained_name_or_path: str | Path, **options: Any
    ) -> PreTrainedConfig:
        if not Path(pretrained_name_or_path).exists() and not is_hub_id(pretrained_name_or_path):
            text = f"there is no folder {pretrained_name_or_path} here, and it is no name on the Hub"
            raise DecodingError((), text)
        try:
            return usual.__func__(cls, pretrained_name_or_path, **options)
        except LocalEntryNotFoundError as error:
            raise DecodingError((), f"there is no folder {pretrained_name_or_path} here. {error}") from error
        except (ValueError, TypeError, AttributeError, RecursionError) as error:
            damage = _damage(local_file(pretrained_name_or_path, options.get("revision"), CONFIG))
            if damage is None and isinstance(error, AttributeError | RecursionError):
                raise
            start = f"{pretrained_name_or_path}: its config.json cannot be read: "
            raise DecodingError((), start + (damage or str(error))) from error

    show: Any = sys.excepthook

    def show_uncaught(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        if isinstance(error, DecodingError):
            print(f"error: {error}", file=sys.stderr)
        else:
            show(kind, error, trace)

    sys.excepthook = show_uncaught
    PreTrainedConfig.from_pretrained = classmethod(from_pretrained)  # pyright: ignore[reportAttributeAccessIssue]
