"""LeRobot's warning of a torchcodec that cannot be loaded: one line, and all others as they were."""

import importlib
import importlib.util
import logging

import pytest
from lerobot.utils import import_utils

import lerobot_policy_bomb  # noqa: F401  the plugin
from lerobot_bomb.compat.hooks.torchcodec import NO_TORCHCODEC_IN_SHORT
from lerobot_bomb.compat.use import use

use()


def test_it_is_one_line(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    def no_ffmpeg(name: str) -> None:
        raise RuntimeError("Could not load libtorchcodec. Likely causes:\n" + 100 * "  Traceback of 100 %s\n")

    monkeypatch.setattr(importlib.util, "find_spec", lambda name: True)
    monkeypatch.setattr(importlib, "import_module", no_ffmpeg)
    assert import_utils.get_safe_default_video_backend() == "pyav"
    assert [record.getMessage() for record in caplog.records] == [NO_TORCHCODEC_IN_SHORT]
    assert caplog.records[0].levelname == "WARNING"


def test_other_messages_of_that_logger_stay(caplog: pytest.LogCaptureFixture) -> None:
    logger = logging.getLogger(import_utils.__name__)
    logger.warning("'torchcodec' is not available in your platform, falling back to %s", "'pyav'")
    assert caplog.messages == ["'torchcodec' is not available in your platform, falling back to 'pyav'"]
