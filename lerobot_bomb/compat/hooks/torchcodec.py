"""LeRobot's warning of a torchcodec that cannot be loaded, as one line."""

import logging

from lerobot.utils import import_utils

# what LeRobot's warning ends in, below a hundred lines of torchcodec's own
NO_TORCHCODEC = "'torchcodec' is installed but cannot be loaded"
NO_TORCHCODEC_IN_SHORT = (
    "torchcodec cannot be loaded, usually because FFmpeg's libraries are missing; videos are read with PyAV "
    "(the cause: python -c 'import torchcodec')"
)


def shorten_torchcodec_warning() -> None:
    """Let LeRobot say in one line that it reads videos with PyAV; doing it again changes nothing."""
    logging.getLogger(import_utils.__name__).addFilter(_shorten)


def _shorten(record: logging.LogRecord) -> bool:
    if NO_TORCHCODEC in record.getMessage():
        record.msg, record.args = NO_TORCHCODEC_IN_SHORT, None
    return True
