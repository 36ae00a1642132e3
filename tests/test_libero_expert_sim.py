"""The scripted expert of LIBERO in its simulator: it solves a task and records it.

Needs hf-libero and its assets of one suite; skips without.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lerobot_bomb.commands import main as cli
from lerobot_bomb.data.dataset_files import INFO_FILE, read_parquet
from lerobot_bomb.data.facts import DatasetFacts
from lerobot_bomb.data.libero_conversion import libero_layout
from lerobot_bomb.data.libero_recording import LiberoRollouts, _act
from lerobot_bomb.envs.rollout import run_episode
from lerobot_bomb.libero.assets import Libero
from lerobot_bomb.libero.episode import LiberoSpec

pytestmark = pytest.mark.long

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
    assert facts.eval_flags() == [FLAGS[0], FLAGS[1], *FLAGS[3:], "--env.render_preset=stock"]
    assert list(facts.seeds or ()) == [SEED]
    assert "libero_spatial" in "".join(facts.lines())


def test_gripper_opens_at_minus_one(recorded: Path) -> None:
    actions = np.stack(rows(recorded / "data")["action"].to_numpy())
    assert abs(actions).max() <= 1
    assert actions[0, 6] == -1 and set(actions[:, 6].tolist()) == {-1.0, 1.0}


@pytest.mark.parametrize(
    ("task_id", "seed"),
    [(7, 1001), (7, 1003), (4, 1002), (4, 1008)],  # the bowl is near the arm's base; in a drawer far from it
)
def test_expert_solves_what_it_once_lost(libero_with_assets: Libero, task_id: int, seed: int) -> None:
    """Run episodes in which it asked the arm for a turn out of reach, or gripped the drawer's wall."""
    spec = LiberoSpec(seed, "libero_spatial", task_id)
    rollouts = LiberoRollouts(0.0, {"obs_type": "pixels_agent_pos", "observation_height": SIZE})
    env = rollouts.make_env(spec)
    vars(env.unwrapped)["_scene"]._draws = False  # most of the time
    moments = list(run_episode(env, spec, _act))
    result = env.get_wrapper_attr("episode_result")()
    env.close()
    assert result.is_success and len(moments) < 200
