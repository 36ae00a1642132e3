"""What a dataset's folder says of itself, and how to evaluate on what it shows."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot_bomb.data.dataset_files import INFO_FILE
from lerobot_bomb.data.growing import METADATA_FILE
from lerobot_bomb.json_files import read_json
from lerobot_bomb.schema import PROTOCOL_VERSION

PUSHT_SOURCE = "pusht-zarr"

Row = dict[str, Any]  # the fields of EpisodeResult


@dataclass(frozen=True)
class DatasetFacts:
    """LeRobot's info.json and, of datasets that this package wrote, bomb.json."""

    info: dict[str, Any]
    bomb: dict[str, Any]  # {} = written by others

    @classmethod
    def read(cls, root: Path) -> "DatasetFacts":
        """Of a dataset's folder.

        Raises:
            ValueError: it holds no LeRobotDataset, or a file that is not JSON.
        """
        if not (root / INFO_FILE).is_file():
            raise ValueError(f"{root} holds no {INFO_FILE}, so it is no LeRobotDataset")
        path = root / METADATA_FILE
        return cls(read_json(root / INFO_FILE), read_json(path) if path.is_file() else {})

    @classmethod
    def find(cls, root: Path | str | None) -> "DatasetFacts | None":
        """Of a folder where a dataset was, if one still is there."""
        return cls.read(Path(root)) if root and (Path(root) / INFO_FILE).is_file() else None

    @property
    def recording(self) -> dict[str, Any]:
        """Parameters of `lerobot-bomb record`, or {}."""
        return self.bomb.get("recording", {})

    def eval_flags(self) -> list[str] | None:
        """Of lerobot-eval, for the environment that the dataset shows; None: not known."""
        if self.bomb.get("conversion", {}).get("source", "").startswith(PUSHT_SOURCE):
            return ["--env.type=pusht", "--eval.use_async_envs=false"]
        if not self.recording:
            return None
        names = ("task", "robot", "control_mode", "fps", "image_size")
        flags = [f"--env.{name}={self.recording[name]}" for name in names]
        return ["--env.type=bomb", *flags, *(["--env.depth=true"] if self.recording["depth"] else [])]

    def lines(self) -> list[str]:
        """As Markdown's list."""
        info = self.info
        count = f"{info['total_episodes']} episodes, {info['total_frames']} frames at {info['fps']} Hz"
        return [f"- {count}", *self._recording_lines()]

    def _recording_lines(self) -> list[str]:
        recording = self.recording
        if not recording:
            return []
        num_failed = len(self.bomb["failures"])
        num_conditions = len(recording["perturbations"]) * max(1, len(recording["task_ids"]))
        num_tried = self.bomb["num_episodes"] + num_failed
        first = recording["seed"]
        last = first + (num_tried - 1) // num_conditions
        tasks = recording["task_ids"] or "drawn per episode"
        return [
            f"- BOMB protocol {recording['protocol_version']}, suite `{recording['task']}`, robot "
            f"`{recording['robot']}`, control `{recording['control_mode']}`, split `{recording['split']}`, "
            f"{recording['image_size']} px",
            f"- perturbation axes: `{', '.join(recording['perturbations'])}`; noise on actions: "
            f"{recording['noise']:g}; tasks: {tasks}",
            f"- seeds {first}..{last}; failed episodes that were left out: {num_failed}",
            f"- recorded with lerobot_bomb {recording['package_version']}",
        ]

    @property
    def protocol_version(self) -> str | None:
        """Of the benchmark that the dataset is of, if it is."""
        return self.recording.get("protocol_version")


def eval_flags_of(row: Row) -> list[str]:
    """Of lerobot-eval, for the environment that an evaluation was of."""
    spec = row["spec"]
    flags = {"task": spec["suite"], **{name: spec[name] for name in ("robot", "control_mode", "fps")}}
    flags["image_size"] = row["image_size"]
    return ["--env.type=bomb", *(f"--env.{name}={value}" for name, value in flags.items())]


def protocol_version(dataset: DatasetFacts | None, has_results: bool) -> str | None:
    """Of the benchmark that a checkpoint was trained or evaluated on; None: of no known one."""
    of_dataset = dataset.protocol_version if dataset is not None else None
    return of_dataset or (PROTOCOL_VERSION if has_results else None)
