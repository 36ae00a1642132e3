"""The BOMB environment of a recording, in which a checkpoint trained on it acts."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any

from lerobot_bomb.bomb.board import task_id
from lerobot_bomb.bomb.observation import ACTION_NAMES
from lerobot_bomb.bomb.suite import task_version
from lerobot_bomb.bomb.suites import OWN_SUITES
from lerobot_bomb.compat.help import leave_out_of_help
from lerobot_bomb.conditions import ALL

SUITE = "SUITE"  # stands in flags for an unknown suite, to be filled in
IMAGES, DEPTH = "observation.images.", "observation.depth."
# the meaning of an observation or an action depends on these; --env.NAME changes them
COMPARED = ("task", "robot", "control_mode", "fps", "image_size")


@dataclass(frozen=True)
class Environment:
    """BOMB's settings but perturbations. A policy may act under another depth, split or numbered task."""

    robot: str
    control_mode: str
    # control steps per second
    fps: int
    # width and height of each camera in pixels
    image_size: int
    cameras: tuple[str, ...]
    task_version: str
    # suite; several as "object+place"; None: not known
    task: str | None = None
    depth: bool = False
    # numbered tasks; none = target and colour are drawn per episode; None: not known
    task_ids: tuple[int, ...] | None = None

    @classmethod
    def of_dataset(
        cls, info: Mapping[str, Any], task: str | None, task_ids: tuple[int, ...] | None
    ) -> "Environment | None":
        """Return the environment of a dataset; None if it was not recorded in BOMB.

        Args:
            info: LeRobot's info.json, which stays true when a dataset is merged or edited.
            task: suite or suites, which info.json does not name.
            task_ids: numbered tasks, which info.json does not name either.
        """
        robot = re.fullmatch(r"bomb_(\w+)_v([\d.]+)", str(info.get("robot_type")))
        features: dict[str, Any] = info.get("features", {})
        cameras = {key.removeprefix(IMAGES): features[key] for key in features if key.startswith(IMAGES)}
        sizes = {size for camera in cameras.values() for size in tuple(camera["shape"])[:2]}
        action_names = tuple(features["action"]["names"] or ()) if "action" in features else ()
        modes = [mode for mode, names in ACTION_NAMES.items() if names == action_names]
        if robot is None or len(sizes) != 1 or not modes:
            return None
        return cls(
            robot=robot[1],
            control_mode=modes[0],
            fps=int(info["fps"]),
            image_size=int(sizes.pop()),
            cameras=tuple(cameras),
            task_version=_version(robot[2], task),
            task=task,
            depth=any(key.startswith(DEPTH) for key in features),
            task_ids=task_ids,
        )

    @property
    def suites(self) -> frozenset[str] | None:
        """Suites of the recording; None if unknown."""
        return None if self.task is None else _suites(self.task)

    def _flag(self, name: str) -> str:
        """Return a flag of lerobot-eval; for several suites it names the first, unless they are all."""
        value = getattr(self, name)
        if name == "task" and self.suites is not None:
            value = ALL if self.suites == frozenset(OWN_SUITES) else min(self.suites)
        return f"--env.{name}={SUITE if value is None else value}"

    def eval_flags(self) -> list[str]:
        """Return lerobot-eval's flags for this environment; an unknown suite is to be filled in for SUITE."""
        flags = [self._flag(name) for name in COMPARED]
        if self.depth:
            flags.append("--env.depth=true")
        if self.task_ids:
            flags.append(f"--env.task_ids={list(self.task_ids)}".replace(" ", ""))
        return ["--env.type=bomb", *flags]

    def differences(self, other: "Environment") -> list[str]:
        """Fields whose values in `other` keep a policy of this environment from acting there.

        An unknown suite, and its version, are not compared.
        """
        names = [name for name in COMPARED if getattr(self, name) != getattr(other, name)]
        ours, theirs = self.suites, other.suites
        if "task" in names and (ours is None or theirs is None or theirs <= ours):
            names.remove("task")
        if not set(self.cameras) <= set(other.cameras):
            names.append("cameras")
        is_same_version = self.task_version == other.task_version or (self._is_current and other._is_current)
        if ours is not None and not is_same_version:
            names.append("task_version")
        return names

    @property
    def _is_current(self) -> bool:
        """Return True if all suites have their current versions."""
        return self.suites is not None and self.task_version == _current_version(self.suites)

    def check_same(self, other: "Environment", who: str, override: str) -> None:
        """Raise a ValueError, naming flags to change, unless `who`, trained here, can act in `other`."""
        names = self.differences(other)
        if not names:
            return
        flags = [self._flag(name) for name in names if name in COMPARED]
        ways_out = [f"evaluate with {' '.join(flags)}", override] if flags else [override]
        raise ValueError(
            f"{who} was trained for an environment with {self.text(names)}; this one has "
            f"{other.text(names)}: {', or '.join(ways_out)}"
        )

    def text(self, names: Iterable[str]) -> str:
        """Write these fields: "control_mode=absolute, fps=20"."""
        values = {name: getattr(self, name) for name in names}
        if "cameras" in values:
            values["cameras"] = "+".join(self.cameras)
        return ", ".join(f"{name}={value}" for name, value in values.items())

    def __str__(self) -> str:
        depth = " with depth" if self.depth else ""
        tasks = f", tasks {list(self.task_ids)}" if self.task_ids else ""
        suite = "an unknown suite" if self.task is None else f"suite {self.task}"
        return (
            f"BOMB, task version {self.task_version}, {suite}{tasks}, robot {self.robot}, "
            f"control {self.control_mode} at {self.fps} Hz, cameras {', '.join(self.cameras)} of "
            f"{self.image_size} px{depth}"
        )


def robot_type(robot: str, task: str) -> str:
    """Return `robot_type` of a recording's info.json: its robot and a version.

    The version is the newest of our suites and the recording's. LeRobot merges only datasets of one
    `robot_type`: recordings of several suites, but none of older tasks.
    """
    return f"bomb_{robot}_v{max(map(task_version, (ALL, task)))}"


def _suites(task: str) -> frozenset[str]:
    return frozenset(OWN_SUITES if task == ALL else task.split("+"))


def _current_version(suites: Iterable[str]) -> str:
    return max(map(task_version, suites))


def _version(of_robot: str, task: str | None) -> str:
    """Return the version of a dataset's suites, whose last change may be older than its robot's version."""
    return of_robot if task is None else min(of_robot, _current_version(_suites(task)))


# no command line gives them
leave_out_of_help(Environment, [each.name for each in fields(Environment)])


def numbered_tasks(specs: Iterable[Mapping[str, Any]]) -> tuple[int, ...]:
    """Numbers of the episodes' tasks; empty if each episode draws its task."""
    ids = {numbered_task(spec) for spec in specs}
    return tuple(sorted(number for number in ids if number is not None)) if None not in ids else ()


def numbered_task(spec: Mapping[str, Any]) -> int | None:
    """Return the number of the task that a spec gives, or the one of its target and colour; None: drawn."""
    target, color = spec.get("target"), spec.get("color")
    return task_id(target, color) if target and color else spec.get("task_id")
