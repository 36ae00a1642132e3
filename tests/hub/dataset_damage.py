"""Damage to a recorded dataset's folder of two episodes, by what a refusal says of it."""

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from hub.damage import Damage, remove, truncate, write

VIDEO = "videos/observation.images.wrist/chunk-000/file-000.mp4"
DATA = "data/chunk-000/file-000.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
TASKS, STATISTICS, INFO = "meta/tasks.parquet", "meta/stats.json", "meta/info.json"


def change_json(name: str, change: Callable[[dict[str, Any]], object]) -> Damage:
    def damage(root: Path) -> None:
        values = json.loads((root / name).read_text())
        change(values)
        (root / name).write_text(json.dumps(values))

    return damage


def change_table(name: str, change: Callable[[pa.Table], pa.Table]) -> Damage:
    def damage(root: Path) -> None:
        pq.write_table(change(pq.read_table(root / name)), root / name)

    return damage


def without_last_row(table: pa.Table) -> pa.Table:
    return table.slice(0, len(table) - 1)


def with_nan(table: pa.Table) -> pa.Table:
    actions = table["action"].to_pylist()
    actions[3][1] = math.nan
    field = table.schema.field("action")
    return table.set_column(table.schema.get_field_index("action"), field, pa.array(actions, field.type))


def with_other_index(table: pa.Table) -> pa.Table:
    index = pa.array([0] * len(table))
    return table.set_column(table.schema.get_field_index("index"), "index", index)


def copy_data(root: Path) -> None:
    shutil.copy(root / DATA, (root / DATA).with_name("file-001.parquet"))


def take_a_shorter_video(root: Path) -> None:
    """Replace the video by a whole one of five frames only."""
    with av.open(str(root / VIDEO), "w") as video:
        stream = video.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt = 32, 32, "yuv420p"
        for _ in range(5):
            image = av.VideoFrame.from_ndarray(np.zeros((32, 32, 3), np.uint8), "rgb24")
            video.mux(stream.encode(image))
        video.mux(stream.encode())


DATASET_DAMAGES: dict[str, Damage] = {
    f"{VIDEO} is missing": remove(VIDEO),
    f"{VIDEO} is truncated or no video: ": truncate(VIDEO),
    f"{VIDEO} is truncated or no video: [": write(VIDEO, ""),
    f"{VIDEO} has 5 whole frames, not the ": take_a_shorter_video,
    f"{DATA} is missing": remove(DATA),
    f"{DATA} is truncated or no parquet file": truncate(DATA),
    f"{DATA} is truncated or no parquet file: Parquet file size is 0 bytes": write(DATA, ""),
    f"{DATA} holds ": change_table(DATA, without_last_row),
    f"{DATA}: action is nan in row 3, not finite": change_table(DATA, with_nan),
    f"{DATA}: index does not count the frames": change_table(DATA, with_other_index),
    "file-001.parquet is of no episode, but LeRobot would read it": copy_data,
    f"{DATA} is truncated or no parquet file: No match": change_table(DATA, lambda t: t.drop(["action"])),
    "meta/episodes holds no table of episodes": remove(EPISODES),
    f"{EPISODES} is truncated or no parquet file": truncate(EPISODES),
    "meta/episodes holds 1 episodes of ": change_table(EPISODES, without_last_row),
    f"{TASKS} is missing": remove(TASKS),
    f"{TASKS} is truncated or no parquet file": truncate(TASKS),
    f"{TASKS} does not hold the tasks 0..1": change_table(TASKS, without_last_row),
    "meta has no stats.json": remove(STATISTICS),
    f"{STATISTICS} is not JSON, or truncated": truncate(STATISTICS),
    f"{STATISTICS} has no mean of action": change_json(STATISTICS, lambda s: s.pop("action")),
    f"{STATISTICS}: std of action is not finite": change_json(
        STATISTICS, lambda s: s["action"].update(std=[math.nan] * 4)
    ),
    f"{INFO} is not JSON, or truncated": truncate(INFO),
    f"{INFO} does not say total_episodes": change_json(INFO, lambda i: i.update(total_episodes="2")),
    "meta/info.json says 2 of 1;": change_json(INFO, lambda i: i.update(total_frames=1)),
    "episodes do not follow one another in": change_json(INFO, lambda i: i.update(fps=20)),
    # as after LeRobotDataset.resume, which appends in place
    "holds 2 episodes, but meta/bomb.json says that 1 were made": change_json(
        "meta/bomb.json", lambda b: b.update(num_episodes=1)
    ),
    "frames, but meta/bomb.json says that 1 were made": change_json(
        "meta/bomb.json", lambda b: b.update(num_frames=1)
    ),
    "so lerobot-bomb did not write it": remove("meta/bomb.json"),
    "so it is no LeRobotDataset": remove(INFO),
}
