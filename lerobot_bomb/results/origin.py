"""Origin of a result: which policy ran, with which versions, on which machine.

Simulator workers import this module, so it imports neither torch nor LeRobot.
"""

import json
import platform
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from lerobot_bomb.results.schema import Count, Natural, Sha256

NOT_RECORDED = "not recorded"
SHOWN_DIGITS = 12  # of a SHA-256


@lru_cache(maxsize=None, typed=True)
def json_list(*values: Any) -> str:
    """Return the JSON of hashable values as a list; each is written once, however many records have it."""
    return json.dumps(values)


@cache
def installed_version(distribution: str) -> str | None:
    """Return the version of a Python package; None if it has no metadata."""
    try:
        return version(distribution)
    except PackageNotFoundError:
        return None


def uses_sapien(simulator: str, render_preset: str) -> bool:
    """Return True if SAPIEN simulates or draws."""
    return "sapien" in (simulator, render_preset)


def sapien_version(simulator: str, render_preset: str) -> str | None:
    """Return the installed SAPIEN's version if it simulates or draws; else None."""
    return installed_version("sapien") if uses_sapien(simulator, render_preset) else None


def installed_versions(distributions: Iterable[str]) -> dict[str, str | None]:
    """Return {distribution: version}; None if one has no metadata."""
    return {name: installed_version(name) for name in distributions}


@cache
def machine_name() -> str:
    """Return processor and C library of this machine: "x86_64, AMD EPYC, glibc 2.36".

    The library's sine and cosine vary with the processor, and their last bits are in every state.
    """
    cpus = Path("/proc/cpuinfo")  # of Linux
    lines = cpus.read_text().splitlines() if cpus.is_file() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    parts = (platform.machine(), *models[:1], " ".join(platform.libc_ver()))
    return ", ".join(part for part in parts if part.strip())


@dataclass(frozen=True)
class PolicyIdentity:
    """Policy that acted. One without weights, or built from its config alone, has a type only."""

    type: str  # policy type
    path: str | None = None  # the checkpoint's folder as it was given, or USER/NAME on the Hub
    revision: str | None = None  # commit on the Hub
    weights_sha256: Sha256 | None = None  # SHA-256 of the weights, or of the adapters' weights
    # SHA-256 of the config with this evaluation's flags and of the processors
    settings_sha256: Sha256 | None = None
    base: str | None = None  # checkpoint under the adapters: a folder or USER/NAME@REVISION
    is_in_training: bool = False  # evaluated during a training: the weights are in no file
    # step of the training that it was evaluated at; null: of none, or not recorded
    training_step: Natural | None = None
    # episodes evaluated in one batch; arithmetic rounds differently in a batch of another size
    batch_size: Count | None = None
    batch_row: Natural | None = None  # row of this episode in the batch
    interventions: tuple[str, ...] = ()  # names of the preprocessor's steps that change the input on purpose
    # SHA-256 of the config with this evaluation's flags, without the processors
    config_sha256: Sha256 | None = None

    def describe(self) -> str:
        """Describe the policy: 'act', or 'act outputs/act (weights 0123456789ab, settings 0123456789ab)'."""
        revision = f"@{self.revision}" if self.revision else ""
        sums = {"weights": self.weights_sha256, "settings": self.settings_sha256}
        notes = [f"{name} {sha256[:SHOWN_DIGITS]}" for name, sha256 in sums.items() if sha256]
        notes += [f"adapters of {self.base}"] if self.base else []
        notes += ["in training"] if self.is_in_training else []
        notes += [f"step {self.training_step}"] if self.training_step is not None else []
        notes += [f"with {name}" for name in self.interventions]
        words = [self.type, *([f"{self.path}{revision}"] if self.path else [])]
        return " ".join([*words, *([f"({', '.join(notes)})"] if notes else [])])

    @property
    def flag(self) -> str:
        """Flag of lerobot-eval that names the policy."""
        return f"--policy.type={self.type}" if self.path is None else f"--policy.path={self.path}"

    @property
    def key(self) -> str:
        """Text that is equal for the same weights with the same settings, wherever they lie."""
        values = (self.type, self.weights_sha256, self.settings_sha256, self.base, self.is_in_training)
        step = () if self.training_step is None else (self.training_step,)
        return json_list(*values, *((self.path, self.revision) if self.weights_sha256 is None else ()), *step)


@dataclass(frozen=True)
class Evaluation:
    """LeRobot's evaluation that an episode belongs to."""

    num_episodes: Count  # episodes of the whole evaluation: of all its tasks and conditions
    seed: Natural | None  # --seed: the first episode's; null: not given


def describe_versions(versions: Mapping[str, str | None]) -> str:
    """Describe the packages that an episode's bits depend on: 'gym-pusht 0.1.8, pymunk 6.11.1'."""
    return ", ".join(f"{name} {version or '?'}" for name, version in versions.items())
