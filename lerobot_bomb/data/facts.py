"""What a dataset's folder says of itself, and how to evaluate on what it shows."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from lerobot_bomb.bomb.suite import suites_of
from lerobot_bomb.conditions import ALL
from lerobot_bomb.data.dataset_files import INFO_FILE
from lerobot_bomb.data.environment import Environment
from lerobot_bomb.data.recording import SCENES
from lerobot_bomb.data.resumable import METADATA_FILE
from lerobot_bomb.files import read_json

PUSHT_SOURCE = "pusht-zarr"
LIBERO_SOURCE = "libero-hdf5"
EPISODE_TABLES = "meta/episodes/*/*.parquet"
SPEC_COLUMN = "bomb/spec"


@dataclass(frozen=True)
class DatasetFacts:
    """LeRobot's info.json and, of datasets that this package wrote, bomb.json."""

    info: dict[str, Any]
    bomb: dict[str, Any]  # {} = written or changed by others
    suites: tuple[str, ...] = ()  # of its episodes, where their table alone still says so

    @classmethod
    def read(cls, root: Path) -> "DatasetFacts":
        """Of a dataset's folder.

        Raises:
            ValueError: it holds no LeRobotDataset, or a file that is not JSON.
        """
        if not (root / INFO_FILE).is_file():
            raise ValueError(f"{root} holds no {INFO_FILE}, so it is no LeRobotDataset")
        path = root / METADATA_FILE
        if path.is_file():
            return cls(read_json(root / INFO_FILE), read_json(path))
        return cls(read_json(root / INFO_FILE), {}, suites_of_episodes(root))

    @classmethod
    def find(cls, root: Path | str | None) -> "DatasetFacts | None":
        """Of a folder where a dataset was, if one still is there."""
        return cls.read(Path(root)) if root and (Path(root) / INFO_FILE).is_file() else None

    @property
    def recording(self) -> dict[str, Any]:
        """Parameters of `lerobot-bomb record`, or {}."""
        return self.bomb.get("recording", {})

    @property
    def environment(self) -> Environment | None:
        """That of the benchmark, which the dataset shows; None: another."""
        known = self.recording
        if self.suites:
            known = {"task": self.suites[0] if len(self.suites) == 1 else ALL}
        return Environment.of_dataset(self.info, known)

    def eval_flags(self) -> list[str] | None:
        """Of lerobot-eval, for the environment that the dataset shows; None: not known."""
        conversion = self.bomb.get("conversion", {})
        if conversion.get("source", "").startswith(PUSHT_SOURCE):
            return ["--env.type=pusht", "--eval.use_async_envs=false"]
        if conversion.get("source", "").startswith(LIBERO_SOURCE):
            return self._libero_flags(conversion["suite"])
        return None if self.environment is None else self.environment.eval_flags()

    def _libero_flags(self, suite: str) -> list[str]:
        """Images as large as the dataset's: LeRobot's default is another size."""
        height, width, _ = self.info["features"]["observation.images.image"]["shape"]
        size = [f"--env.observation_height={height}", f"--env.observation_width={width}"]
        return ["--env.type=libero", *([f"--env.task={suite}"] if suite else []), *size]

    def lines(self) -> list[str]:
        """As Markdown's list."""
        info = self.info
        count = f"{info['total_episodes']} episodes, {info['total_frames']} frames at {info['fps']} Hz"
        return [f"- {count}", *self._recording_lines()]

    @property
    def seeds(self) -> range | None:
        """Of the episodes that were tried; None: it is no recording of BOMB."""
        recording = self.recording
        if not recording:
            return None
        num_tasks = len(suites_of(recording["task"])) * max(1, len(recording["task_ids"]))
        num_conditions = len(recording["perturbations"]) * num_tasks
        num_tried = self.bomb["num_episodes"] + len(self.bomb["failures"])
        num_seeds = -(-num_tried // num_conditions) * (min(recording.get("static", 0), SCENES) or 1)
        return range(recording["seed"], recording["seed"] + num_seeds)

    def _recording_lines(self) -> list[str]:
        recording, seeds = self.recording, self.seeds
        num_failed = len(self.bomb.get("failures", []))
        if seeds is None:
            return []
        given = [f"{name} {recording[name]}" for name in ("target", "color") if recording.get(name)]
        tasks = recording["task_ids"] or ", ".join(given) or "drawn per episode"
        return [
            f"- BOMB, task version {recording['protocol_version']}, suite `{recording['task']}`, robot "
            f"`{recording['robot']}`, control `{recording['control_mode']}`, split `{recording['split']}`, "
            f"{recording['image_size']} px",
            f"- perturbation axes: `{', '.join(recording['perturbations'])}`; noise on actions: "
            f"{recording['noise']:g}; tasks: {tasks}",
            f"- seeds {seeds[0]}..{seeds[-1]}; failed episodes that were left out: {num_failed}",
            f"- recorded with lerobot_bomb {recording['package_version']}, MuJoCo "
            f"{recording.get('mujoco_version', 'of an unknown version')}",
        ]


def suites_of_episodes(root: Path) -> tuple[str, ...]:
    """Suites that a dataset's table of episodes names, sorted; a merge keeps the table."""
    specs: set[str] = set()
    for path in sorted(root.glob(EPISODE_TABLES)):
        if SPEC_COLUMN in pq.read_schema(path).names:
            specs |= set(pq.read_table(path, columns=[SPEC_COLUMN])[SPEC_COLUMN].drop_null().to_pylist())
    return tuple(sorted({json.loads(spec)["suite"] for spec in specs}))
