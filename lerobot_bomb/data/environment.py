"""The BOMB environment that a recording shows and that a checkpoint of it acts in."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from lerobot_bomb.bomb.board import task_id
from lerobot_bomb.bomb.observation import ACTION_NAMES
from lerobot_bomb.bomb.suite import task_version
from lerobot_bomb.conditions import ALL

IMAGES, DEPTH = "observation.images.", "observation.depth."
# what an observation or an action means depends on; --env.NAME changes it
COMPARED = ("task", "robot", "control_mode", "fps", "image_size")


@dataclass(frozen=True)
class Environment:
    """A policy may act under another depth, split or task than these; perturbations do not count."""

    robot: str
    control_mode: str
    # control steps per second
    fps: int
    # width and height of each camera in pixels
    image_size: int
    cameras: tuple[str, ...]
    task_version: str
    task: str = "place"
    depth: bool = False
    # numbered tasks; none = target and colour are drawn per episode
    task_ids: tuple[int, ...] = ()

    @classmethod
    def of_dataset(cls, info: Mapping[str, Any], recording: Mapping[str, Any]) -> "Environment | None":
        """From LeRobot's info.json, and what bomb.json says of a recording; None: it is of no such one.

        What is in info.json stays true when a dataset is merged or edited, which bomb.json does not survive.
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
            task_version=robot[2],
            task=recording.get("task", cls.task),
            depth=any(key.startswith(DEPTH) for key in features),
            task_ids=_task_ids(recording),
        )

    @property
    def action_size(self) -> int:
        """Numbers of an action."""
        return len(ACTION_NAMES[self.control_mode])

    def eval_flags(self) -> list[str]:
        """Of lerobot-eval, for this environment."""
        flags = [f"--env.{name}={getattr(self, name)}" for name in COMPARED]
        if self.depth:
            flags.append("--env.depth=true")
        if self.task_ids:
            flags.append(f"--env.task_ids={list(self.task_ids)}".replace(" ", ""))
        return ["--env.type=bomb", *flags]

    def differences(self, other: "Environment") -> list[str]:
        """Fields in which `other` is one that a policy of this environment cannot act in."""
        # what was trained on all suites acts in each of them, as long as none has become another
        mine = replace(self, task=other.task, task_version=other.task_version) if self._is_of_all else self
        names = [name for name in COMPARED if getattr(mine, name) != getattr(other, name)]
        if not set(self.cameras) <= set(other.cameras):
            names.append("cameras")
        if mine.task_version != other.task_version:
            names.append("task_version")
        return names

    @property
    def _is_of_all(self) -> bool:
        return self.task == ALL and self.task_version == task_version(ALL)

    def check_same(self, other: "Environment", who: str, insist: str) -> None:
        """Raise a ValueError, which names flags to change, unless `who`, of this one, can act in `other`."""
        names = self.differences(other)
        if not names:
            return
        flags = [f"--env.{name}={getattr(self, name)}" for name in names if name in COMPARED]
        ways_out = [f"evaluate with {' '.join(flags)}", insist] if flags else [insist]
        raise ValueError(
            f"{who} was trained for an environment with {self.text(names)}; this one has "
            f"{other.text(names)}: {', or '.join(ways_out)}"
        )

    def text(self, names: Iterable[str]) -> str:
        """These fields: "control_mode=absolute, fps=20"."""
        values = {name: getattr(self, name) for name in names}
        if "cameras" in values:
            values["cameras"] = "+".join(self.cameras)
        return ", ".join(f"{name}={value}" for name, value in values.items())

    def __str__(self) -> str:
        depth = " with depth" if self.depth else ""
        tasks = f", tasks {list(self.task_ids)}" if self.task_ids else ""
        return (
            f"BOMB, task version {self.task_version}, suite `{self.task}`{tasks}, robot `{self.robot}`, "
            f"control `{self.control_mode}` at {self.fps} Hz, cameras `{', '.join(self.cameras)}` of "
            f"{self.image_size} px{depth}"
        )


def _task_ids(recording: Mapping[str, Any]) -> tuple[int, ...]:
    """Of a recording whose tasks were given by number, or by a target and a colour."""
    target, color = recording.get("target"), recording.get("color")
    if target and color:
        return (task_id(target, color),)
    return tuple(recording.get("task_ids", ()))
