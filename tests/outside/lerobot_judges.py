"""Pytest plugin: our policy and env types in the place of LeRobot's in LeRobot's own tests.

The tests stay as they are. From here come the names they are parametrised with, the defaults of our configs
and what is demanded of a saved policy beyond LeRobot's comparison. `run_judges.py` starts pytest with it.
"""

import functools
import json
from collections.abc import Generator
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
import torch
from draccus.choice_types import ChoiceRegistry
from lerobot.configs import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from lerobot.policies import PreTrainedPolicy
from lerobot.policies.factory import get_policy_class
from lerobot.utils.import_utils import register_third_party_plugins
from recipes import POLICY_TYPES
from run_judges import BUILD, CLASSES, FILES, MAKE_ENV, ROOT, SAVE_AND_LOAD

from lerobot_bomb.libero.assets import SUITES, prepare_libero

MIN_TENSORS = 10
# for every config that has the field, unless the test gives a value
DEFAULTS = {"vlm_model_name": "nano", "device": "cpu"}


def own_types(registry: type[ChoiceRegistry], folder: str) -> list[str]:
    """Names in a registry of LeRobot that the packages in `folder` of this project put there."""
    packages = {path.name for path in (ROOT / folder).iterdir() if path.is_dir()}
    choices = registry.get_known_choices()
    return sorted(name for name, choice in choices.items() if choice.__module__.split(".")[0] in packages)


def set_defaults(config_class: type[PreTrainedConfig]) -> None:
    """Let a policy config that is created without the fields of DEFAULTS have these."""
    names = {field.name for field in fields(config_class)}
    defaults = {name: value for name, value in DEFAULTS.items() if name in names}
    init = config_class.__init__

    @functools.wraps(init)
    def init_with_defaults(self: PreTrainedConfig, *args: Any, **kwargs: Any) -> None:
        init(self, *args, **{**defaults, **kwargs})

    config_class.__init__ = init_with_defaults


def redraw(policy: PreTrainedPolicy) -> None:
    """Draw every parameter anew: zeros and ones of the initialisation would pass for loaded values."""
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.uniform_(-1, 1)


def check_config_file(folder: Path, config: PreTrainedConfig) -> None:
    """Check that the file holds everything: LeRobot's test loads with its config, a user without."""
    stored = json.loads((folder / "config.json").read_text())
    lost = {field.name for field in fields(config)} - stored.keys()
    assert not lost, f"config.json of {config.type} has no {sorted(lost)}"
    assert PreTrainedConfig.from_pretrained(folder) == config


def has_libero() -> bool:
    """Return True if LIBERO and its assets are there; otherwise print what is missing."""
    try:
        prepare_libero([SUITES[0]])
    except ValueError as error:
        print(f"bomb_libero is not judged: {error}")
        return False
    return True


def pytest_configure(config: pytest.Config) -> None:
    register_third_party_plugins()
    policies, envs = own_types(PreTrainedConfig, "policies"), own_types(EnvConfig, "envs")
    if not POLICY_TYPES or not envs or not set(POLICY_TYPES) <= set(policies):
        raise pytest.UsageError(
            f"LeRobot knows of this project the policy types {policies} and the env types {envs}; configs/ "
            f"names {POLICY_TYPES}. `lerobot-bomb doctor` says what does not import"
        )
    envs = [name for name in envs if name != "bomb_libero" or has_libero()]
    for name in policies:
        set_defaults(PreTrainedConfig.get_choice_class(name))
    config.pluginmanager.register(Judges(POLICY_TYPES, policies, envs))


class Judges:
    """Swaps the names in, watches saving and loading, and fails a run that judged less than it should."""

    def __init__(self, learnt: list[str], policies: list[str], envs: list[str]):
        # scripted policies have nothing to save and act on BOMB's 4 actions only, the tests' robot has 6
        self.swapped = {
            CLASSES: ("policy_name", policies),
            BUILD: ("policy_name", learnt),
            SAVE_AND_LOAD: ("policy_name", learnt),
            MAKE_ENV: ("env_name", envs),
        }
        self.expected = {f"{test}[{name}]" for test, (_, names) in self.swapped.items() for name in names}
        self.passed: set[str] = set()
        self.tensors: dict[str, list[int]] = {name: [] for name in learnt}
        self.problems: list[str] = []

    @pytest.hookimpl(tryfirst=True)
    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        """Replace the test's own parameters before pytest reads them."""
        if metafunc.definition.nodeid not in self.swapped:
            return
        argument, names = self.swapped[metafunc.definition.nodeid]
        marks = metafunc.definition.own_markers
        [old] = [mark for mark in marks if mark.name == "parametrize" and mark.args[0] == argument]
        marks[marks.index(old)] = pytest.mark.parametrize(argument, names).mark

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: pytest.Function) -> Generator[None, None, None]:
        with pytest.MonkeyPatch.context() as patch:
            if item.nodeid.startswith(f"{SAVE_AND_LOAD}["):
                self._watch(str(item.callspec.params["policy_name"]), patch)
            if item.nodeid.startswith(f"{MAKE_ENV}["):
                # LeRobot skips environments that no package `gym_<type>` brings; ours is a plugin
                patch.setattr("tests.utils.is_package_available", lambda _: True)
            return (yield)

    def _watch(self, name: str, patch: pytest.MonkeyPatch) -> None:
        """Redraw a policy before it is saved, check its config file, count tensors before and after."""
        policy_class = get_policy_class(name)
        save, load = policy_class.save_pretrained, policy_class.from_pretrained

        def watched_save(policy: PreTrainedPolicy, folder: Path) -> None:
            self._count(name, policy)
            redraw(policy)
            save(policy, folder)
            check_config_file(folder, policy.config)

        def watched_load(*args: Any, **kwargs: Any) -> PreTrainedPolicy:
            policy = load(*args, **kwargs)
            self._count(name, policy)
            return policy

        patch.setattr(policy_class, "save_pretrained", watched_save)
        patch.setattr(policy_class, "from_pretrained", staticmethod(watched_load))

    def _count(self, name: str, policy: PreTrainedPolicy) -> None:
        count = len(list(policy.parameters()))
        assert count >= MIN_TENSORS, f"{name} has {count} tensors to compare, fewer than {MIN_TENSORS}"
        self.tensors[name].append(count)

    def _num_passed(self, test: str) -> int:
        return sum(passed.startswith((f"{test}::", f"{test}[")) for passed in self.passed)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "call" and report.passed:
            self.passed.add(report.nodeid)

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        self.problems += [f"{test} did not pass" for test in sorted(self.expected - self.passed)]
        self.problems += [f"no test of {path} passed" for path in FILES if not self._num_passed(path)]
        self.problems += [
            f"{name}: tensors were counted {len(counts)} times, not before saving and after loading"
            for name, counts in self.tensors.items()
            if len(counts) != 2
        ]
        if len(self.passed) < session.testscollected:
            self.problems.append(f"{len(self.passed)} of {session.testscollected} tests passed")
        if self.problems:
            session.exitstatus = session.exitstatus or pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        terminalreporter.section("judged by LeRobot's tests")
        for test, (_, names) in self.swapped.items():
            terminalreporter.line(f"{test}: {self._num_passed(test)} passed ({', '.join(names)})")
        for path in FILES:
            terminalreporter.line(f"{path}: {self._num_passed(path)} passed")
        for name, counts in self.tensors.items():
            terminalreporter.line(f"{name}: tensors before saving and after loading: {counts}")
        for problem in self.problems:
            terminalreporter.line(f"JUDGED TOO LITTLE: {problem}", red=True)
