"""The scripted expert of LIBERO in its simulator: it solves a task, and records it as LeRobot would show it.

Needs hf-libero and its assets of one suite; skips without.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset
from lerobot.envs.utils import preprocess_observation
from lerobot.processor.env_processor import LiberoProcessorStep

from lerobot_bomb.commands import main as cli
from lerobot_bomb.data.dataset_files import EPISODES_FOLDER, INFO_FILE, read_parquet
from lerobot_bomb.data.facts import DatasetFacts
from lerobot_bomb.data.libero_conversion import libero_layout
from lerobot_bomb.data.libero_recording import LiberoRecording
from lerobot_bomb.libero.assets import Libero
from lerobot_bomb.libero.episode import LiberoSpec
from lerobot_bomb.results.reading import read_records

SIZE = 32
SEED = 5
TASK_ID = 4  # the bowl is in a drawer
FLAGS = (
    "--env.type=bomb_libero", "--env.task=libero_spatial", f"--env.task_ids=[{TASK_ID}]",
    f"--env.observation_height={SIZE}", f"--env.observation_width={SIZE}",
)  # fmt: skip


@pytest.fixture(scope="module")
def recorded(libero_with_assets: Libero, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record an episode with noise, so with recoveries."""
    root = tmp_path_factory.mktemp("recorded") / "data"
    flags = ["record", *FLAGS, "--repo_id=test/libero", "--episodes=1", "--images", "--noise=0.1"]
    assert cli.main([*flags, f"--seed={SEED}", f"--root={root}"]) == 0
    return root


def rows(folder: Path) -> Any:
    """The table of a dataset with one file of rows."""
    return read_parquet(next(folder.rglob("*.parquet")))


def batched(values: Any) -> Any:
    """An observation as that of one environment in a batch."""
    if isinstance(values, dict):
        return {key: batched(value) for key, value in values.items()}
    return values[None]


def test_schema_is_that_of_converted_files(recorded: Path) -> None:
    info = json.loads((recorded / INFO_FILE).read_text())
    layout = libero_layout("test/libero", (SIZE, SIZE, 3), use_videos=False)
    assert (info["fps"], info["robot_type"]) == (layout.fps, layout.robot_type)
    for name, wanted in layout.features.items():
        found = info["features"][name]
        assert (found["dtype"], tuple(found["shape"])) == (wanted["dtype"], tuple(wanted["shape"]))
        assert list(found["names"]) == list(wanted["names"])


def test_recording_names_its_environment(recorded: Path) -> None:
    facts = DatasetFacts.read(recorded)
    assert facts.eval_flags() == [FLAGS[0], FLAGS[1], *FLAGS[3:]]
    assert list(facts.seeds or ()) == [SEED]
    assert "libero_spatial" in "".join(facts.lines())


def test_frames_are_as_a_policy_sees_them(recorded: Path) -> None:
    spec = json.loads(rows(recorded / EPISODES_FOLDER)["bomb/spec"][0].as_py())
    assert (spec["seed"], spec["task_id"]) == (SEED, TASK_ID)
    recording = LiberoRecording("test/libero", 1, observation_height=SIZE, observation_width=SIZE)
    env = recording.settings.make_env(LiberoSpec(**spec))
    observation, _ = env.reset(seed=SEED)
    seen = LiberoProcessorStep().observation(preprocess_observation(batched(observation)))
    first = LeRobotDataset("test/libero", root=recorded)[0]
    for name in ("observation.images.image", "observation.images.image2", "observation.state"):
        np.testing.assert_allclose(first[name].numpy(), seen[name][0].numpy(), atol=1e-6)
    assert first["task"] == env.get_wrapper_attr("task_description")
    env.close()


def test_gripper_opens_at_minus_one(recorded: Path) -> None:
    actions = np.stack(rows(recorded / "data")["action"].to_numpy())
    assert abs(actions).max() <= 1
    assert actions[0, 6] == -1 and set(actions[:, 6].tolist()) == {-1.0, 1.0}


def test_sync_and_async_give_the_same_episodes(
    libero_with_assets: Libero, stock_cli: Callable[..., None], tmp_path: Path
) -> None:
    path = tmp_path / "results.jsonl"
    flags = (*FLAGS, f"--env.results_path={path}", "--policy.type=bomb_expert", f"--seed={SEED}")
    for use_async in ("false", "true"):
        stock_cli(
            "lerobot-eval", *flags, "--eval.n_episodes=2", "--eval.batch_size=2",
            f"--eval.use_async_envs={use_async}", f"--output_dir={tmp_path / use_async}",
        )  # fmt: skip
    found, damage = read_records(path)
    facts: dict[int, set[tuple[Any, ...]]] = {}
    for record in found.values():
        assert record.is_success
        facts.setdefault(record.spec.seed, set()).add((record.steps, record.action_j2, record.action_j3))
    assert not damage and len(found) == 4
    assert facts.keys() == {SEED, SEED + 1} and all(len(each) == 1 for each in facts.values())
