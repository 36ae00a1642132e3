# pyright: reportAttributeAccessIssue=false, reportInvalidTypeForm=false
"""Episodes for the page of `make_play.py`: starts, plans, and what each axis at each level changes."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from tqdm import tqdm

from lerobot_bomb.bomb import board
from lerobot_bomb.bomb.board import NUM_STONES
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.layout import Layout
from lerobot_bomb.bomb.move import Move
from lerobot_bomb.bomb.perturbations import AXES
from lerobot_bomb.bomb.streams import Stream, generator
from lerobot_bomb.bomb.suite import Episode, find_suite
from lerobot_bomb.bomb.suites import OWN_SUITES
from lerobot_bomb.conditions import MAX_LEVEL
from lerobot_env_bomb.bomb import model as model_module
from lerobot_env_bomb.bomb import robots
from lerobot_env_bomb.bomb.axes.dynamics import Dynamics
from lerobot_env_bomb.bomb.axes.photometric import Sensor
from lerobot_env_bomb.bomb.axes.transform import Transform
from lerobot_env_bomb.bomb.perturb import PerturbedEpisode, perturb
from lerobot_env_bomb.bomb.scene import EDITABLE, ModelEdit, Scene
from lerobot_env_bomb.shared.mujoco_gl import mujoco

ROBOT = "scara"
LAYOUT_DIGITS = 9  # of metres: a nanometre
NOISE_DIGITS = 6  # of standard deviations


def as_number(value: Any) -> float | int:
    """Return the shortest number that is this one in its own precision."""
    return int(value) if isinstance(value, np.integer) else float(str(value))


def differences(nominal: Mapping[str, np.ndarray], changed: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """{array: [flat indices, values there]} of arrays that differ."""
    sparse = {}
    for name, values in changed.items():
        places = np.flatnonzero(values.ravel() != nominal[name].ravel())
        if places.size:
            sparse[name] = [places.tolist(), [as_number(each) for each in values.ravel()[places]]]
    return sparse


def arrays_of(model: mujoco.MjModel, names: Iterable[str]) -> dict[str, np.ndarray]:
    """Copies of a model's arrays, and of its headlight."""
    headlight = model.vis.headlight
    lamp = {f"headlight.{name}": getattr(headlight, name).copy() for name in ("ambient", "diffuse")}
    return {name: getattr(model, name).copy() for name in names} | lamp


class ModelEdits:
    """Changes of the compiled model as numbers, each kept once."""

    def __init__(self) -> None:
        self.changes: list[dict[str, Any]] = []
        self._places: dict[str, int] = {}
        self._scene = Scene(ROBOT)
        # all stones show, black and white in turn
        self._layout = Layout(
            gripper_xyz=np.array([*board.TRAY_CENTER_XY, 0.1]),
            stone_xy=np.zeros((NUM_STONES, 2)),
            stone_is_white=np.arange(NUM_STONES) % 2 == 1,
            stone_in_play=np.ones(NUM_STONES, dtype=bool),
        )
        self._visuals = [
            self._scene.model.geom(f"{model_module.stone_name(i)}_visual").id for i in range(NUM_STONES)
        ]
        self._nominal = self._arrays((), {})

    def _arrays(self, edits: Sequence[ModelEdit], pattern: Mapping[Any, str]) -> dict[str, np.ndarray]:
        self._scene.reset(self._layout, edits, pattern)
        return arrays_of(self._scene.model, EDITABLE)

    def number(self, edits: Sequence[ModelEdit] = (), pattern: Mapping[Any, str] | None = None) -> int | None:
        """Return the place in `changes` of what edits and a pattern change together; None: nothing."""
        arrays = self._arrays(edits, pattern or {})
        black, white = (arrays["geom_rgba"][self._visuals[i]].copy() for i in range(2))
        # which stones are white, an episode says
        arrays["geom_rgba"][self._visuals] = self._nominal["geom_rgba"][self._visuals]
        change = differences(self._nominal, arrays)
        if not np.array_equal(black, self._nominal["geom_rgba"][self._visuals[0]]):
            change["stone_rgba"] = {
                "black": [as_number(each) for each in black],
                "white": [as_number(each) for each in white],
            }
        if not change:
            return None
        key = json.dumps(change)
        if key not in self._places:
            self._places[key] = len(self.changes)
            self.changes.append(change)
        return self._places[key]


def rounded(values: Iterable[float], digits: int = LAYOUT_DIGITS) -> list[float]:
    """Return numbers of few characters."""
    return [round(float(each), digits) for each in values]


def start_of(drawn: Episode) -> dict[str, Any]:
    """Return what shows at the start of an episode: words, gripper, stones."""
    layout = drawn.layout
    stones = np.flatnonzero(layout.stone_in_play)
    assert stones.tolist() == [*range(len(stones))], "stones in play come first"
    return {
        "instructions": [turn.instruction for turn in drawn.turns],
        "gripper": rounded(layout.gripper_xyz),
        "arm": rounded(robots.ROBOTS[ROBOT].joints(layout.gripper_xyz, 0.0).values()),
        "stones": [[*rounded(layout.stone_xy[i]), int(layout.stone_is_white[i])] for i in stones],
        "stone_size": rounded([layout.stone_radius_m, layout.stone_height_m]),
    }


def move_record(each: Move) -> dict[str, Any]:
    """Return a move as JSON."""
    return {
        "stones": sorted(each.stones),
        "places": sorted(each.places, key=str),
        "after": sorted(each.after),
        "is_slid": each.is_slid,
    }


@dataclass
class SuiteExport:
    """Episodes of a suite: every numbered task with every seed, plain and under each axis at each level."""

    suite: str
    seeds: Sequence[int]

    def __post_init__(self) -> None:
        self._edits = ModelEdits()
        self._numbers: dict[str, int | None] = {}  # of transforms that have been seen

    def record(self) -> dict[str, Any]:
        """Return all that the page knows of the suite."""
        suite = find_suite(self.suite)
        tasks = tqdm(range(suite.num_tasks), desc=self.suite)
        episodes = [[self._episode(task, seed) for seed in self.seeds] for task in tasks]
        return {
            "max_steps": suite.max_steps,
            "num_goals": suite.num_goals,
            # the task that a seed draws where none is asked for
            "drawn": [suite.sample(EpisodeSpec(seed, self.suite)).task_id for seed in self.seeds],
            "episodes": episodes,
            "edits": self._edits.changes,
        }

    def _episode(self, task: int, seed: int) -> dict[str, Any]:
        suite = find_suite(self.suite)
        nominal = suite.sample(suite.of_task(EpisodeSpec(seed, self.suite), task))
        start = start_of(nominal)
        pattern = self._edits.number(pattern=nominal.pattern) if nominal.pattern else None
        return {
            **start,
            "plans": [[move_record(each) for each in plan] for plan in nominal.plans],
            "first_stone": nominal.aims[0].stone,
            "target": nominal.target,
            "pattern": pattern,
            "axes": {
                axis: [self._change(nominal, start, axis, level) for level in range(1, MAX_LEVEL + 1)]
                for axis in AXES
            },
        }

    def _change(self, nominal: Episode, start: dict[str, Any], axis: str, level: int) -> dict[str, Any]:
        """Return what an axis at a level changes in an episode."""
        spec = replace(nominal.spec, perturbations=f"{axis}:{level}")
        drawn = perturb(replace(nominal, spec=spec))
        change = {key: value for key, value in start_of(drawn).items() if value != start[key]}
        if (edit := self._edit(drawn, axis)) is not None:
            change["edit"] = edit
        if (dynamics := drawn.perturbation.of(Dynamics)) is not None:
            change |= {"noise": dynamics.noise, "latency": dynamics.latency}
        if (sensor := drawn.perturbation.of(Sensor)) is not None:
            change["sensor"] = {"gains": sensor.photometric.gains, "noise": sensor.photometric.noise}
        return change

    def _edit(self, drawn: PerturbedEpisode, axis: str) -> int | None:
        transform = drawn.perturbation.transforms[axis]
        if type(transform).edit_model is Transform.edit_model:
            return None
        key = repr(transform)
        if key not in self._numbers:
            self._numbers[key] = self._edits.number([transform.edit_model])
        return self._numbers[key]


def most_steps() -> int:
    """Return the control steps of the longest episode of any suite."""
    return max(find_suite(suite).max_steps for suite in OWN_SUITES)


def actuator_noise(seed: int) -> list[float]:
    """Standard normal numbers, three for each control step, as the actuator of a seed draws them."""
    rng = generator(seed, Stream.ACTUATOR_NOISE)
    return rounded(rng.standard_normal(3 * most_steps()), NOISE_DIGITS)
