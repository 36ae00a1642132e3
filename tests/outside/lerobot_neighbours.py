"""Pytest plugin: LeRobot's tests beside our plugin, or as if there were none; writes what they say."""

import json
import os
import sys
from pathlib import Path
from typing import Any

import pytest
from lerobot.utils.import_utils import register_third_party_plugins
from run_neighbours import OUTCOMES, WITH_PLUGIN

ENTRY: str = "lerobot_policy_bomb"


class Outcomes:
    """Outcome of every test: the first that is no pass, or passed."""

    def __init__(self) -> None:
        self.of: dict[str, str] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "call" or not report.passed:
            self.of.setdefault(report.nodeid, report.outcome)

    def pytest_sessionfinish(self) -> None:
        Path(os.environ[OUTCOMES]).write_text(json.dumps(self.of))


def pytest_configure(config: pytest.Config) -> None:
    modules: dict[str, Any] = sys.modules
    if os.environ[WITH_PLUGIN]:
        register_third_party_plugins()
        if ENTRY not in modules:
            raise pytest.UsageError("the plugin is not registered; `lerobot-bomb doctor` says why")
    else:
        modules[ENTRY] = None  # whoever imports it finds none
    config.pluginmanager.register(Outcomes())
