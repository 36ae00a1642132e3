"""Facts about a dataset from its folder, and the flags that evaluate in its environment."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot_bomb.bomb.environment import Environment, numbered_tasks
from lerobot_bomb.bomb.suite import suites_of
from lerobot_bomb.data.dataset_files import INFO_FILE, episode_tables
from lerobot_bomb.data.recording import SCENES
from lerobot_bomb.data.unfinished import METADATA_FILE
from lerobot_bomb.files import read_json
from lerobot_bomb.libero.episode import TASKS_PER_SUITE
from lerobot_bomb.results.libero import LiberoResult

PUSHT_SOURCE = "pusht-zarr"
LIBERO_SOURCE = "libero-hdf5"
DONE = "next.done"  # as in LeRobot's constants, whose import takes seconds
# columns of LeRobot's table of episodes
SPEC_COLUMN = "bomb/spec"
LEAST_DONE = f"stats/{DONE}/min"  # 1: every frame is the last one of its own


@dataclass(frozen=True)
class DatasetFacts:
    """LeRobot's info.json and, for datasets that this package wrote, bomb.json or the episodes' columns.

    LeRobot's editing tools lose bomb.json when they write a new dataset; some keep the columns.
    """

    info: dict[str, Any]
    bomb: dict[str, Any]  # {} = written or edited by others
    # `EpisodeSpec` of each episode and static scene as JSON, read where bomb.json is gone; None: one has none
    specs: Sequence[dict[str, Any]] | None = None

    @classmethod
    def read(cls, root: Path) -> "DatasetFacts":
        """Read the facts of a dataset's folder.

        Raises:
            ValueError: it holds no LeRobotDataset, or a file that is not JSON.
        """
        if not (root / INFO_FILE).is_file():
            raise ValueError(f"{root} holds no {INFO_FILE}, so it is no LeRobotDataset")
        info, path = read_json(root / INFO_FILE), root / METADATA_FILE
        if path.is_file():
            return cls(info, read_json(path))
        is_bomb = Environment.of_dataset(info, None, None) is not None
        return cls(info, {}, _read_specs(root, info) if is_bomb else None)

    @classmethod
    def find(cls, root: Path | str | None) -> "DatasetFacts | None":
        """Read the facts of a dataset's folder; None if the dataset is gone."""
        return cls.read(Path(root)) if root and (Path(root) / INFO_FILE).is_file() else None

    @property
    def recording(self) -> dict[str, Any]:
        """Parameters of `lerobot-bomb record`, or {}."""
        return self.bomb.get("recording", {})

    @property
    def _is_libero(self) -> bool:
        """True for a recording of LIBERO's expert."""
        return self.recording.get("env_type") == LiberoResult.env_type

    @property
    def conversion(self) -> dict[str, Any]:
        """Parameters of `lerobot-bomb convert`, or {}."""
        return self.bomb.get("conversion", {})

    @property
    def environment(self) -> Environment | None:
        """BOMB environment of the dataset; None if it has another."""
        return Environment.of_dataset(self.info, *self._tasks)

    @property
    def _tasks(self) -> tuple[str | None, tuple[int, ...] | None]:
        """Return `Environment.task` and `Environment.task_ids`; None for the numbers of several suites."""
        if self.recording:
            given = tuple(self.recording.get("task_ids", ()))
            return self.recording.get("task"), numbered_tasks([self.recording]) or given
        suites = sorted({spec["suite"] for spec in self.specs or ()})
        if len(suites) != 1:
            return "+".join(suites) or None, None
        return suites[0], numbered_tasks(self.specs or ())

    def eval_flags(self) -> list[str] | None:
        """Return lerobot-eval's flags for the dataset's environment; None if unknown."""
        conversion = self.conversion
        if self._is_libero:
            preset = self.recording.get("render_preset")
            flags = [] if preset is None else [f"--env.render_preset={preset}"]
            return ["--env.type=bomb_libero", *self._libero_flags(self.recording["task"])[1:], *flags]
        if conversion.get("source", "").startswith(PUSHT_SOURCE):
            return ["--env.type=pusht", "--eval.use_async_envs=false"]
        if conversion.get("source", "").startswith(LIBERO_SOURCE):
            return self._libero_flags(conversion["suite"])
        return None if self.environment is None else self.environment.eval_flags()

    def _libero_flags(self, suite: str) -> list[str]:
        """Return the flags for images as large as the dataset's: LeRobot's default is another size."""
        height, width, _ = self.info["features"]["observation.images.image"]["shape"]
        size = [f"--env.observation_height={height}", f"--env.observation_width={width}"]
        return ["--env.type=libero", *([f"--env.task={suite}"] if suite else []), *size]

    def lines(self) -> list[str]:
        """Return what was recorded, as items of a list; `plain` makes them safe for Markdown."""
        return [f"- {self.count}", *self._recording_lines()]

    @property
    def count(self) -> str:
        """Episodes, frames and rate in words."""
        info = self.info
        return f"{info['total_episodes']} episodes, {info['total_frames']} frames at {info['fps']} Hz"

    @property
    def perturbations(self) -> list[str] | None:
        """Conditions of the episodes; None if unknown."""
        if self.recording:
            return list(self.recording["perturbations"])
        return None if self.specs is None else sorted({spec["perturbations"] for spec in self.specs})

    @property
    def seeds(self) -> Sequence[int] | None:
        """Seeds of all tried episodes; in an edited recording, of those left in it; None if unknown."""
        recording = self.recording
        if not recording:
            return None if self.specs is None else sorted({spec["seed"] for spec in self.specs})
        task, task_ids = recording["task"], recording["task_ids"]
        if self._is_libero:
            num_tasks = len(task_ids) or TASKS_PER_SUITE[task]
        else:
            num_tasks = len(suites_of(task)) * max(1, len(task_ids))
        num_conditions = len(recording["perturbations"]) * num_tasks
        num_tried = self.bomb["num_episodes"] + len(self.bomb["failures"])
        num_seeds = -(-num_tried // num_conditions) * (min(recording.get("static", 0), SCENES) or 1)
        return range(recording["seed"], recording["seed"] + num_seeds)

    def _recording_lines(self) -> list[str]:
        recording, seeds = self.recording, self.seeds
        if not recording or seeds is None:
            return []
        num_failed = len(self.bomb.get("failures", []))
        if self._is_libero:
            return [
                f"- LIBERO's suite {recording['task']}, tasks: {recording['task_ids'] or 'all'}",
                f"- perturbation axes: {', '.join(recording['perturbations'])}; noise on actions: "
                f"{recording['noise']:g}",
                f"- seeds {seeds[0]}..{seeds[-1]}; failed episodes that were left out: {num_failed}",
                f"- recorded with lerobot_bomb {recording['package_version']}",
            ]
        given = [f"{name} {recording[name]}" for name in ("target", "color") if recording.get(name)]
        tasks = recording["task_ids"] or ", ".join(given) or "drawn per episode"
        return [
            f"- BOMB, task version {recording['protocol_version']}, suite {recording['task']}, robot "
            f"{recording['robot']}, control {recording['control_mode']}, split {recording['split']}, "
            f"{recording['image_size']} px",
            f"- perturbation axes: {', '.join(recording['perturbations'])}; noise on actions: "
            f"{recording['noise']:g}; tasks: {tasks}",
            f"- seeds {seeds[0]}..{seeds[-1]}; failed episodes that were left out: {num_failed}",
            f"- recorded with lerobot_bomb {recording['package_version']}, MuJoCo "
            f"{recording.get('mujoco_version', 'of an unknown version')}",
        ]


def _read_specs(root: Path, info: Mapping[str, Any]) -> list[dict[str, Any]] | None:
    """Return `EpisodeSpec` of each episode, and of each static scene, as JSON; None if one has none.

    Static scenes are stored as an episode, a frame each, which is the last one of its own: their seeds count
    up from the one that is stored.

    Raises:
        ValueError: a table of episodes is truncated.
    """
    tables = episode_tables(root)
    names = [SPEC_COLUMN, "length", *([LEAST_DONE] if DONE in info["features"] else [])]
    if not tables or any(not set(names) <= set(table.column_names) for table in tables):
        return None
    specs = []
    for row in (row for table in tables for row in table.select(names).to_pylist()):
        if row[SPEC_COLUMN] is None:
            return None
        spec, num_scenes = json.loads(row[SPEC_COLUMN]), row["length"] if row.get(LEAST_DONE) == [1.0] else 1
        specs += [{**spec, "seed": spec["seed"] + i} for i in range(num_scenes)]
    return specs
