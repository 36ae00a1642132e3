"""The page that plays BOMB in a browser: its simulation, expert and judge end episodes as Python's do."""

import base64
import gzip
import json
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Any

import make_play
import numpy as np
import pytest
import torch
from play_episodes import ROBOT, start_of
from play_policy import load

from lerobot_bomb.bomb.episode import TEST_SEEDS, EpisodeSpec, Stage
from lerobot_bomb.bomb.expert import expert_action
from lerobot_bomb.bomb.observation import CAMERAS, RenderOptions
from lerobot_bomb.bomb.perturbations import AXES
from lerobot_bomb.bomb.privileged_state import PrivilegedState
from lerobot_bomb.bomb.suite import find_suite
from lerobot_bomb.bomb.suites import OWN_SUITES
from lerobot_bomb.conditions import MAX_LEVEL, NONE
from lerobot_env_bomb.bomb.env import BombEnv
from lerobot_env_bomb.bomb.perturb import perturb
from lerobot_env_bomb.bomb.scene import Scene

RUNNER = Path(__file__).parent / "fixtures" / "play.mjs"
ACTOR = RUNNER.with_name("play_policy.mjs")
VISITOR = RUNNER.with_name("play_in_browser.mjs")
# what runs a command before each browser, and the browser; a headless Firefox has no WebGL without a GPU
BROWSERS = {
    "chromium": ([], shutil.which("chromium") or shutil.which("google-chrome")),
    "firefox": ([shutil.which("xvfb-run"), "-a"], shutil.which("firefox")),
}
SEEDS = TEST_SEEDS[:2]
CLOSE_M = 1e-4  # of a stone's position at the end, in most episodes
# in all: where fingers close on a stone, the solver stops one iteration sooner or later, by the last bit
TOLERANCE_M = 4e-4

needs_mujoco = pytest.mark.skipif(
    shutil.which("node") is None or not all(path.is_file() for path in make_play.PACKAGES),
    reason="needs node and npm's packages, which `make npm` installs",
)

HAS_EXPORTER = find_spec("onnxscript") is not None

needs_exporter = pytest.mark.skipif(not HAS_EXPORTER, reason="needs onnxscript, of `make play`")

needs_browser = pytest.mark.skipif(
    not HAS_EXPORTER or not (make_play.NODE_MODULES / "playwright-core").is_dir(),
    reason="needs onnxscript and npm's playwright-core: make play NPM_FLAGS=--include=dev",
)


def job(suite: str, task: int, seed: int, **levels: int) -> dict[str, Any]:
    """An episode that both sides play, with {axis: level}."""
    return {"suite": suite, "task": task, "seed": seed, "levels": levels}


def spec_of(suite: str, task: int, seed: int, levels: dict[str, int]) -> EpisodeSpec:
    """Return what identifies a job's episode in Python."""
    condition = "+".join(f"{axis}:{level}" for axis, level in levels.items()) or NONE
    return replace(find_suite(suite).of_task(EpisodeSpec(seed, suite), task), perturbations=condition)


def play(
    suite: str,
    task: int,
    seed: int,
    levels: dict[str, int],
    act: Callable[[PrivilegedState], np.ndarray] = expert_action,
) -> dict[str, Any]:
    """Play an episode in Python; return how it ends, and its actions."""
    env = BombEnv(spec_of(suite, task, seed, levels), RenderOptions(image_size=32))
    observation, info = env.reset(seed=seed)
    instruction, actions, has_ended = env.task_description, [], False
    while not has_ended:
        actions.append(act(PrivilegedState.from_vector(observation["environment_state"])))
        observation, _, terminated, truncated, info = env.step(actions[-1])
        has_ended = terminated or truncated
    stone_xyz = env.privileged_state().stone_xyz
    env.close()
    kept = ("is_success", "stage", "progress")
    return {name: info[name] for name in kept} | {
        "instruction": instruction,
        "steps": len(actions),
        "failure": info["failure"] or None,
        "stone_xyz": stone_xyz,
        "actions": actions,
    }


def in_node(page: Path, jobs: list[dict[str, Any]], *flags: str) -> list[dict[str, Any]]:
    """Play episodes in JavaScript; return how they end."""
    command = ["node", RUNNER, page, *flags]
    node = subprocess.run(command, input=json.dumps(jobs), capture_output=True, text=True, check=True)
    return json.loads(node.stdout)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page with episodes of a few seeds."""
    folder = tmp_path_factory.mktemp("play")
    make_play.build(folder, SEEDS, with_policy=HAS_EXPORTER)
    return folder


def check_alike(page: Path, jobs: list[dict[str, Any]]) -> list[float]:
    """Play the episodes on both sides; return how far apart, in metres, a stone of each ends."""
    apart_m = []
    for each, there in zip(jobs, in_node(page, jobs), strict=True):
        here = play(**each)
        del here["actions"]
        apart_m.append(float(np.abs(np.array(there["stone_xyz"]) - here.pop("stone_xyz")).max()))
        # a stone comes to rest a step sooner or later
        assert abs(there["steps"] - here.pop("steps")) <= 2, each
        assert {name: there[name] for name in here} == here, each
        assert apart_m[-1] < TOLERANCE_M, each
    return apart_m


@needs_mujoco
def test_episodes_end_as_in_python(page: Path) -> None:
    jobs = [job(suite, task, SEEDS[0]) for suite, task in zip(OWN_SUITES, (2, 10, 3, 17, 3), strict=True)]
    jobs += [job("place", 3, SEEDS[1], **{axis: 5}) for axis in ("dynamics", "object", "stones", "language")]
    jobs.append(job("place", 3, SEEDS[1], stones=4, start=4, dynamics=3, object=3))
    check_alike(page, jobs)


@needs_mujoco
def test_axes_together_change_what_they_change_in_python(page: Path) -> None:
    rng = np.random.default_rng(0)
    jobs = []
    for i in range(40):
        suite = OWN_SUITES[i % len(OWN_SUITES)]
        axes = rng.permutation(list(AXES))[: rng.integers(2, len(AXES) + 1)]
        levels = {axis: int(rng.integers(1, MAX_LEVEL + 1)) for axis in AXES if axis in axes}
        jobs.append(job(suite, int(rng.integers(find_suite(suite).num_tasks)), SEEDS[i % 2], **levels))
    scene = Scene(ROBOT)
    for each, there in zip(jobs, in_node(page, jobs, "--starts"), strict=True):
        spec = spec_of(**each)
        drawn = perturb(find_suite(spec.suite).sample(spec))
        scene.reset(drawn.layout, drawn.perturbation.model_edits, drawn.pattern)
        assert there["instruction"] == drawn.turns[0].instruction
        assert there["stones"] == start_of(drawn)["stones"], each
        for name, values in there["arrays"].items():
            here = getattr(scene.model, name)
            found = np.array(values).reshape(here.shape)
            if name == "geom_rgba":  # what is hidden may have any colour
                here, found = (np.where(rgba[:, 3:] > 0, rgba, 0) for rgba in (here, found))
            assert np.allclose(found, here, rtol=1e-5, atol=1e-7), (each, name)


@pytest.mark.long
@needs_mujoco
@pytest.mark.parametrize("suite", OWN_SUITES)
def test_many_episodes_end_as_in_python(page: Path, suite: str) -> None:
    tasks = range(min(find_suite(suite).num_tasks, 10))
    apart_m = check_alike(page, [job(suite, task, seed) for task in tasks for seed in SEEDS])
    assert sum(each < CLOSE_M for each in apart_m) >= 10
    check_alike(page, [job(suite, 5, SEEDS[1], **{axis: level}) for axis in AXES for level in (3, 5)])


def still(state: PrivilegedState) -> np.ndarray:
    """Do nothing."""
    return np.array([0, 0, 0, 1], dtype=np.float32)


def elsewhere(offset_m: float) -> Callable[[PrivilegedState], np.ndarray]:
    """Act as the expert that puts the stone down beside its place."""

    def act(state: PrivilegedState) -> np.ndarray:
        goals = tuple(replace(goal, xyz=goal.xyz + np.array([0.0, offset_m, 0.0])) for goal in state.goals)
        return expert_action(replace(state, goals=goals))

    return act


def another_stone(state: PrivilegedState) -> np.ndarray:
    """Act as the expert that moves a stone that is not meant."""
    goals = tuple(replace(goal, stone=(goal.stone + 1) % 2) for goal in state.goals)
    return expert_action(replace(state, goals=goals))


def lifting(state: PrivilegedState) -> np.ndarray:
    """Act as the expert that carries a stone which is to be pushed."""
    return expert_action(replace(state, goals=tuple(replace(goal, is_slid=False) for goal in state.goals)))


def open_handed(state: PrivilegedState) -> np.ndarray:
    """Act as the expert with fingers that never close."""
    return np.array([*expert_action(state)[:3], 1], dtype=np.float32)


def holding(state: PrivilegedState) -> np.ndarray:
    """Act as the expert that lifts the stone and stays there."""
    action = expert_action(state)
    return np.array([0, 0, 0, -1], dtype=np.float32) if state.stage == Stage.LIFTED else action


def dropping(state: PrivilegedState) -> np.ndarray:
    """Act as the expert that lifts the stone high and lets it go."""
    if state.stage != Stage.LIFTED:
        return expert_action(state)
    return np.array([0, 0, 1, -1 if state.gripper_xyz[2] < 0.1 else 1], dtype=np.float32)


@needs_mujoco
def test_failures_have_the_class_that_python_gives(page: Path) -> None:
    policies = {
        "never_reached": (job("place", 7, SEEDS[0]), still),
        "missed_grasp": (job("place", 7, SEEDS[0]), open_handed),
        "timeout_holding": (job("place", 7, SEEDS[0]), holding),
        "dropped": (job("place", 7, SEEDS[0]), dropping),
        "imprecise": (job("place", 12, SEEDS[1]), elsewhere(0.015)),
        "wrong_intersection": (job("spatial", 5, SEEDS[1]), elsewhere(-0.045)),
        "wrong_stone": (job("object", 0, SEEDS[0]), another_stone),
        "lifted": (job("goal", 5, SEEDS[0]), lifting),
    }
    here = {name: play(**each, act=act) for name, (each, act) in policies.items()}
    jobs = [
        each | {"actions": [action.tolist() for action in here[name]["actions"]]}
        for name, (each, _) in policies.items()
    ]
    there = in_node(page, jobs)
    assert [each["failure"] for each in here.values()] == list(policies)
    assert [each["failure"] for each in there] == list(policies)
    assert [each["stage"] for each in there] == [each["stage"] for each in here.values()]


@needs_mujoco
def test_every_task_and_axis_is_there(page: Path) -> None:
    for suite in OWN_SUITES:
        record = json.loads(gzip.decompress((page / f"{suite}.json.gz").read_bytes()))
        assert len(record["episodes"]) == find_suite(suite).num_tasks
        for seed, drawn in zip(SEEDS, record["drawn"], strict=True):
            assert drawn == find_suite(suite).sample(EpisodeSpec(seed, suite)).task_id
        for episode in (each for task in record["episodes"] for each in task):
            # every axis changes every episode, at every level
            assert all(all(changes) for axis, changes in episode["axes"].items() if axis != "start")


def queries(name: str, seeds: range, max_steps: int) -> tuple[list[dict[str, Any]], np.ndarray]:
    """Observations of a shipped policy's episodes in all suites, and its (N, D) actions."""
    policy, before, after = load(name)
    observations, actions = [], []
    for suite, seed in product(OWN_SUITES, seeds):
        env = BombEnv(EpisodeSpec(0, suite), RenderOptions(image_size=64))
        policy.reset()
        observation, _ = env.reset(seed=seed)
        for step in range(max_steps):
            images = {camera: observation["pixels"][camera] for camera in CAMERAS}
            batch = {
                **{f"observation.images.{each}": to_tensor(image) for each, image in images.items()},
                "observation.state": torch.from_numpy(observation["agent_pos"])[None],
                "task": [env.task_description],
            }
            with torch.no_grad():
                action = after(policy.select_action(before(batch)))[0].numpy()
            rgb = base64.b64encode(np.stack([*images.values()]).tobytes()).decode()
            state = observation["agent_pos"].tolist()
            observations.append(
                {"rgb": rgb, "state": state, "instruction": env.task_description, "step": step}
            )
            actions.append(action)
            observation, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                break
        env.close()
    return observations, np.stack(actions)


def to_tensor(image: np.ndarray) -> torch.Tensor:
    """(H, W, 3) uint8 -> (1, 3, H, W) in [0, 1]."""
    return torch.from_numpy(image).permute(2, 0, 1)[None] / 255


@pytest.mark.long
@needs_mujoco
@needs_exporter
def test_the_policy_acts_as_in_python(page: Path) -> None:
    observations, actions = queries(make_play.POLICY, range(1000, 1003), max_steps=15)
    assert len(observations) >= 200
    command = ["node", ACTOR, page]
    node = subprocess.run(command, input=json.dumps(observations), capture_output=True, text=True, check=True)
    apart = np.abs(np.array(json.loads(node.stdout)) - actions).max(axis=1)  # in units of 40 mm
    # a resized pixel that is all but a tie between two grey levels may become the other one
    assert np.quantile(apart, 0.9) < 1e-4
    assert apart.max() < 1e-3


@pytest.fixture(scope="module", params=BROWSERS)
def visit(page: Path, request: pytest.FixtureRequest) -> dict[str, Any]:
    """Try all of the page as a visitor; return what it shows."""
    before, browser = BROWSERS[request.param]
    command = [*before, "node", VISITOR, page, make_play.NODE_MODULES, browser]
    if None in command:
        pytest.skip("needs Chromium, or Firefox and xvfb-run")
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


@pytest.mark.long
@needs_mujoco
@needs_browser
def test_a_sentence_a_click_and_keys_put_the_stone_there(visit: dict[str, Any]) -> None:
    assert visit["problems"] == []
    for tried in ("sentence", "click", "keyboard"):
        assert visit[tried]["outcomes"][0].startswith("Success after "), visit[tried]
    assert "&task=13&words=Put%20a" in visit["sentence"]["hash"]  # black, row 2, column 3
    assert visit["click"]["pressed"] == "row 0, column 4"
    # from the target that seed 1000 draws, a row down and a column to the right
    assert (visit["keyboard"]["from"], visit["keyboard"]["to"]) == ("row 1, column 0", "row 2, column 1")
    assert visit["picture"]["hash"].endswith("task=37")  # white, the star point
    assert "off the board" in visit["picture"]["message"]


@pytest.mark.long
@needs_mujoco
@needs_browser
def test_a_perturbed_episode_stands_beside_the_clean_one(visit: dict[str, Any]) -> None:
    assert visit["compared"]["titles"] == ["Seed 1001, camera 2, dynamics 5", "Same seed, clean"]
    assert all(each.startswith("Success") for each in visit["compared"]["outcomes"])
    assert (
        "--env.task=goal --env.perturbations='[\"camera:2+dynamics:5\"]' --seed=1001"
        in visit["compared"]["command"]
    )
    assert len(visit["tabs"]) == 2 and all(each.startswith("Success") for each in visit["tabs"])


@pytest.mark.long
@needs_mujoco
@needs_browser
def test_a_shipped_policy_acts_in_the_page(visit: dict[str, Any]) -> None:
    assert visit["policy"]["outcomes"][1].startswith("Success")  # on the clean scene
    assert "--policy.path=bomb:fdvla_suites" in visit["policy"]["command"]


@pytest.mark.long
@needs_mujoco
@needs_browser
def test_a_shipped_policy_reads_the_visitors_own_words(visit: dict[str, Any]) -> None:
    sentence = "Please move one white piece to the Go board, row 2 and column 1!"
    words = visit["words"]
    assert (words["message"], words["instruction"], words["shown"]) == ("", sentence, sentence)
    assert words["outcomes"][0].startswith(("Success", "Failed"))
    assert "task=36&words=Please%20move" in words["link"]  # white, row 2, column 1
    assert "ask for different things" in words["other"]
    assert words["after"] != sentence


@pytest.mark.long
@needs_mujoco
@needs_browser
def test_sliders_perturb_and_a_button_ends_it(visit: dict[str, Any]) -> None:
    sliders = visit["sliders"]
    assert sliders["hash"].endswith("&perturbations=light:2+language:1")
    assert sliders["titles"] == ["Seed 1000, light 2, language 1", "Same seed, clean"]
    assert (sliders["after"], sliders["level"]) == ("#suite=place&seed=1000", "0")


@pytest.mark.long
@needs_mujoco
@needs_browser
@pytest.mark.parametrize(
    ("tried", "said"),
    {
        "unknown": "does not understand “Mach mir bitte einen Kaffee.”",
        "twisted": "does not understand",
        "off_board": "Row 7, column 2 is off the board: rows and columns go from 0 to 4.",
        "long": "10,002 characters",
        "empty": "Type a sentence first.",
        "markup": "does not understand “<img",
        "#suite=chess": "goal, long, object, place, spatial",
        "#seed=3": "it goes from 1000 to 1001",
        "#perturbations=camera:9": "level of camera “9”; it goes from 1 to 5",
        "#perturbations=fog:1": "perturbation “fog”; there are table, ",
        "#task=50": "Suite place has tasks 0 to 49",
        "#suite=place&mode=x": "“mode”",
    }.items(),
)
def test_what_the_page_cannot_do_it_says(visit: dict[str, Any], tried: str, said: str) -> None:
    assert said in visit["refused"][tried]


@pytest.mark.long
@needs_mujoco
@needs_browser
def test_the_page_works_on_a_phone_and_says_what_a_browser_lacks(visit: dict[str, Any]) -> None:
    assert visit["phone"] == {"width": 390, "violations": []}
    assert "WebGL 2" in visit["missing"]["webgl"]
    assert "WebAssembly" in visit["missing"]["wasm"]
