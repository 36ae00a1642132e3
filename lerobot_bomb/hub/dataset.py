"""What a dataset's folder says of itself, and how to evaluate on what it shows."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lerobot_bomb.data.growing import METADATA_FILE
from lerobot_bomb.environment import Environment
from lerobot_bomb.schema import CAMERAS, TASK_VERSION, task_id

INFO_FILE = Path("meta") / "info.json"
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
            ValueError: it holds no LeRobotDataset.
        """
        if not (root / INFO_FILE).is_file():
            raise ValueError(f"{root} holds no {INFO_FILE}, so it is no LeRobotDataset")
        path = root / METADATA_FILE
        try:
            bomb = json.loads(path.read_text()) if path.is_file() else {}
            return cls(json.loads((root / INFO_FILE).read_text()), bomb)
        except json.JSONDecodeError as error:
            raise ValueError(f"{root / 'meta'} holds a file that is not JSON: {error}") from error

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
        return Environment.of_dataset(self.info, self.recording)

    def eval_flags(self) -> list[str] | None:
        """Of lerobot-eval, for the environment that the dataset shows; None: not known."""
        if self.bomb.get("conversion", {}).get("source", "").startswith(PUSHT_SOURCE):
            return ["--env.type=pusht", "--eval.use_async_envs=false"]
        return None if self.environment is None else self.environment.eval_flags()

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
            f"- recorded with lerobot_bomb {recording['package_version']}, MuJoCo "
            f"{recording.get('mujoco_version', 'of an unknown version')}",
        ]


def environment_of_episode(row: Row) -> Environment:
    """That an episode was played in; of its depth and tasks nothing is said."""
    spec = row["spec"]
    return Environment(
        **{name: spec[name] for name in ("robot", "control_mode", "fps")},
        image_size=row["image_size"],
        cameras=CAMERAS,
        protocol_version=row.get("task_version", row["protocol_version"]),
        task=spec["suite"],
    )


def eval_flags_of(rows: list[Row]) -> list[str]:
    """Of lerobot-eval, for the environment and the tasks that an evaluation was of."""
    specs = [row["spec"] for row in rows]
    task_ids = rows[0].get("task_ids") or ()  # lines of protocol 1.0 do not say
    if not task_ids and all(spec["target"] and spec["color"] for spec in specs):
        task_ids = sorted({task_id(spec["target"], spec["color"]) for spec in specs})
    environment = replace(environment_of_episode(rows[0]), task_ids=tuple(task_ids))
    asked = {} if task_ids else {name: specs[0][name] for name in ("target", "color") if specs[0][name]}
    return [
        *environment.eval_flags(),
        *(f"--env.{name}={value}".replace(" ", "") for name, value in asked.items()),
    ]


def check_results(path: Path, rows: list[Row], trained_for: Environment | None) -> None:
    """Raise a ValueError if episodes were played in another environment than a checkpoint was trained for."""
    if trained_for is None:
        return
    for row in rows:
        played_in = environment_of_episode(row)
        names = trained_for.differences(played_in)
        if names:
            raise ValueError(
                f"--results={path} has an episode with {played_in.text(names)} (seed {row['spec']['seed']}); "
                f"this checkpoint was trained for {trained_for.text(names)}: a card states no rate of "
                "another setting"
            )


def protocol_version(trained_for: Environment | None, has_results: bool) -> str | None:
    """Of the benchmark that a checkpoint was trained or evaluated on; None: of no known one."""
    if trained_for is not None:
        return trained_for.protocol_version
    return TASK_VERSION if has_results else None
