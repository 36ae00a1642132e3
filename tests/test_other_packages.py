"""Additions of another package: an env type, and by entry points an environment, axis, suite and section."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from lerobot_bomb.registry import Registry

PACKAGE = Path(__file__).parent / "fixtures" / "other_package"
ACT = "--policy.dim_model=8 --policy.n_heads=1 --policy.dim_feedforward=8 --policy.use_vae=false"
ACT += " --policy.pretrained_backbone_weights=null --policy.device=cpu"
# prints JSON: what the test looks at
PROGRAM = """
import json, sys
from dataclasses import replace
import numpy as np
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.observation import RenderOptions
from lerobot_bomb.bomb.perturbations import AXES, Condition
from lerobot_bomb.bomb.suite import suites_of
from lerobot_bomb.commands.main import main
from lerobot_bomb.environments import env_type
from lerobot_bomb.envs.rollout import expert_agent, make_env, run_episode
from lerobot_bomb.results.writing import write_record

folder, act = sys.argv[1:]
flags = [f"{folder}/sweep", "--policies=act", "--env.type=plain", "--episodes=4", "--seed=7", *act.split()]
codes = [main(["sweep", *flags])]
spec = EpisodeSpec(3, "corner", perturbations="fog:2")
env = make_env(spec, RenderOptions(32))
first, *_ = run_episode(env, spec, expert_agent())
result = env.unwrapped.episode_result()
write_record(f"{folder}/bomb.jsonl", result)
clear, _ = make_env(replace(spec, perturbations="none"), RenderOptions(32)).reset(seed=3)
images = first.observation["pixels"]["wrist"], clear["pixels"]["wrist"]
files = [f"{folder}/sweep/results.jsonl", f"{folder}/bomb.jsonl"]
codes.append(main(["report", *files, f"--output={folder}/report.html"]))
codes.append(main(["sweep", f"{folder}/new", "--policies=act", "--env.type=tiny", "--tasks=up"]))
told = {
    "codes": codes,
    "fog": int(np.abs(images[0] - (0.8 * images[1] + 0.2 * 255)).max()),
    "result": [result.is_success, list(result.target), result.levels],
    "all": [str(Condition("fog:2+all:3")), [*AXES][-1], "corner" in suites_of("all")],
    "tiny": [*env_type("tiny").record.versions],
}
print(json.dumps(told))
"""


def test_another_package_adds_env_types_axes_suites_and_sections(tmp_path: Path) -> None:
    environment = os.environ | {"PYTHONPATH": str(PACKAGE)}
    command = [sys.executable, "-c", PROGRAM, str(tmp_path), ACT]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    assert json.loads(ended.stdout.splitlines()[-1]) == {
        "codes": [0, 0, 1],
        "fog": 0,
        "result": [True, [0, 0], {"fog": 2}],
        "all": ["all:3+fog:2", "fog", False],
        "tiny": ["lerobot-tiny-1.0"],
    }
    assert "--env.task='up' is unknown; choose one of: left, right" in ended.stderr
    rows: list[dict[str, Any]] = [
        json.loads(line) for line in (tmp_path / "sweep" / "results.jsonl").read_text().splitlines()
    ]
    assert [row["spec"]["seed"] for row in rows] == [7, 8, 9, 10]
    assert {row["protocol_version"] for row in rows} == {"lerobot-plain-1.0"}
    assert [row["is_success"] for row in rows] == [row["max_reward"] == 1 for row in rows]
    page = (tmp_path / "report.html").read_text()
    assert "hello, act, plain" in page and "hello, policy not recorded, corner" in page
    assert "--env.type=plain" in page and "fog:2" in page


def test_a_name_that_is_taken_and_one_that_is_not_there_name_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    added = "[lerobot_bomb.suites]\nplace = more:PLACE\n[lerobot_bomb.report_sections]\nx = more:x\n"
    files = {"METADATA": "Metadata-Version: 2.1\nName: more\nVersion: 1\n", "entry_points.txt": added}
    folder = tmp_path / "more-1.0.dist-info"
    folder.mkdir()
    for name, text in files.items():
        (folder / name).write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    suites = Registry[Any]("lerobot_bomb.suites", {"place": 1})
    assert suites["place"] == 1
    with pytest.raises(RuntimeError, match=r"suites: place = more:PLACE of more: there is another place"):
        list(suites)
    with pytest.raises(RuntimeError, match=r"x = more:x of more cannot be imported: No module named 'more'"):
        Registry[Any]("lerobot_bomb.report_sections", {})["x"]
