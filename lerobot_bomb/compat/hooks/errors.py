"""Errors of our code, and of configs that cannot be read, as one line of LeRobot's commands."""

import dis
import os
import sys
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any

from draccus.utils import DecodingError
from huggingface_hub.errors import LocalEntryNotFoundError
from lerobot.configs import PreTrainedConfig

from lerobot_bomb.compat.hooks.replace import replace
from lerobot_bomb.compat.use import is_of_ours

SHOW_TRACEBACK = "LEROBOT_BOMB_TRACEBACK"  # environment variable


def tell_config_errors(
    is_hub_id: Callable[[str | Path], bool], damage: Callable[[str | Path, str | None], str | None]
) -> None:
    """Let LeRobot's commands say in one line why they cannot read a config.

    Their parser prints DecodingErrors, and turns others into `Couldn't instantiate class EvalPipelineConfig`.
    `damage(path or name on the Hub, revision)` says why a config.json is no policy's.
    """

    def around(usual: Callable[..., PreTrainedConfig]) -> Callable[..., PreTrainedConfig]:
        def from_pretrained(
            cls: type[PreTrainedConfig], pretrained_name_or_path: str | Path, **options: Any
        ) -> PreTrainedConfig:
            if not Path(pretrained_name_or_path).exists() and not is_hub_id(pretrained_name_or_path):
                text = f"there is no folder {pretrained_name_or_path} here, and it is no name on the Hub"
                raise DecodingError((), text)
            try:
                return usual(cls, pretrained_name_or_path, **options)
            except LocalEntryNotFoundError as error:
                text = f"there is no folder {pretrained_name_or_path} here. {error}"
                raise DecodingError((), text) from error
            except (ValueError, TypeError, AttributeError, RecursionError) as error:
                found = damage(pretrained_name_or_path, options.get("revision"))
                if found is None and isinstance(error, AttributeError | RecursionError):
                    raise
                start = f"{pretrained_name_or_path}: its config.json cannot be read: "
                raise DecodingError((), start + (found or str(error))) from error

        return from_pretrained

    replace(PreTrainedConfig, "from_pretrained", around)


def tell_refusals() -> None:
    """Let LeRobot's commands end in one line where our code refuses something, or with Ctrl-C.

    Such an error says what to do, and a traceback would hide that; LEROBOT_BOMB_TRACEBACK=1 shows it. A
    DecodingError is one line, too: lerobot-train reads a checkpoint's config after its parser, which would
    print it so.
    """
    command, usual = Path(sys.argv[0]).stem.replace("_", "-"), sys.excepthook
    if not command.startswith("lerobot-") or os.environ.get(SHOW_TRACEBACK):
        return

    def tell(kind: type[BaseException], error: BaseException, traceback: TracebackType | None) -> None:
        if isinstance(error, DecodingError):
            print(f"error: {error}", file=sys.stderr)
        elif issubclass(kind, KeyboardInterrupt):
            print(f"{command}: interrupted", file=sys.stderr)
        elif isinstance(error, (ValueError, OSError, RuntimeError)) and _is_ours(traceback):
            print(f"{command}: error: {error}", file=sys.stderr)
        else:
            usual(kind, error, traceback)

    sys.excepthook = tell


def _is_ours(traceback: TracebackType | None) -> bool:
    """Return True if the error comes from a `raise` statement in a module of ours."""
    if traceback is None:
        return False
    while traceback.tb_next is not None:
        traceback = traceback.tb_next
    frame = traceback.tb_frame
    is_raise = frame.f_code.co_code[traceback.tb_lasti] == dis.opmap["RAISE_VARARGS"]
    return is_raise and is_of_ours(frame.f_globals.get("__name__", ""))
