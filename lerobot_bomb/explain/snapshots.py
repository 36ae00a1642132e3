"""Snapshots of an episode in which a policy acts, and the moments to explain."""

from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import Any

import gymnasium
import numpy as np

from lerobot_bomb.bomb.board import BOARD, Intersection
from lerobot_bomb.bomb.camera import PinholeCamera
from lerobot_bomb.bomb.expert import current_goal
from lerobot_bomb.bomb.observation import ENVIRONMENT_STATE
from lerobot_bomb.bomb.privileged_state import PrivilegedState
from lerobot_bomb.envs.rollout import Moment
from lerobot_bomb.explain.film import EpisodeRun, run_for_explanation
from lerobot_bomb.explain.phases import PHASES, gripper_does, phases_of
from lerobot_bomb.viewing.checkpoint import LoadedPolicy
from lerobot_bomb.viewing.episode import Viewed, ViewedRun


@dataclass(frozen=True)
class Snapshot:
    """A moment: the policy's observation, and facts that only the environment knows."""

    step: int
    phase: str  # of PHASES; "" where the environment has none
    observation: dict[str, Any]
    instruction: str
    objects: Mapping[str, Mapping[str, np.ndarray]]  # {camera: {what: (H, W) bool}}; {}: not known
    others: Mapping[
        str, tuple[str, Intersection]
    ]  # other instructions and the intersections that they name, by what they change
    target: Intersection | None
    state: PrivilegedState | None  # of BOMB
    cameras: Mapping[str, PinholeCamera]  # {}: not known
    does: str = ""  # what the gripper does, in words

    @property
    def stone_xyz(self) -> np.ndarray | None:
        """(3,) metres, centre of the stone that is to be moved."""
        return None if self.state is None else self.state.stone_xyz[current_goal(self.state).stone]

    @property
    def instructions(self) -> dict[str, str]:
        """Other instructions, by what they change."""
        return {word: instruction for word, (instruction, _) in self.others.items()}


def take_snapshots(viewed: Viewed, loaded: LoadedPolicy) -> tuple[list[Snapshot], EpisodeRun]:
    """Return every moment in which the policy acts, and the episode as it ran."""
    loaded.begin()
    taken: list[Snapshot] = []

    def act(observation: dict[str, Any], instruction: str) -> np.ndarray:
        return loaded.agent([observation], [instruction])[0]

    def take(env: gymnasium.Env, moment: Moment) -> None:
        if moment.action is not None:
            taken.append(_snapshot(moment, env))

    run = run_for_explanation(ViewedRun(viewed, lambda _: nullcontext(act)), with_film=True, watch=take)
    if taken[0].state is None:
        return taken, run
    states = [each.state for each in taken if each.state is not None]
    named = [
        replace(each, phase=phase, does=gripper_does(phase, stone, state))
        for each, state, (phase, stone) in zip(taken, states, phases_of(states), strict=True)
    ]
    return named, run


def _snapshot(moment: Moment, env: gymnasium.Env) -> Snapshot:
    is_bomb = ENVIRONMENT_STATE in moment.observation
    state = moment.state if is_bomb else None
    others = env.get_wrapper_attr("alternatives")() if is_bomb else {}
    goal = None if state is None else current_goal(state)
    return Snapshot(
        step=moment.step,
        phase="",
        observation=moment.observation,
        instruction=moment.instruction,
        objects=env.get_wrapper_attr("object_masks")() if is_bomb else {},
        others=others,
        target=None if goal is None or not others else BOARD.nearest_intersection(goal.xyz[:2]),
        state=state,
        cameras=env.get_wrapper_attr("cameras")() if is_bomb else {},
    )


def middle_of_phases(moments: list[Snapshot]) -> list[Snapshot]:
    """Return the middle moment of each phase in time; of an episode without phases, the middle one."""
    by_phase = [[each for each in moments if each.phase == phase] for phase in (*PHASES, "")]
    return sorted((each[len(each) // 2] for each in by_phase if each), key=lambda each: each.step)


def at_step(moments: list[Snapshot], step: int) -> Snapshot:
    """Return the moment before a control step.

    Raises:
        ValueError: the episode ended before.
    """
    if not 0 <= step < len(moments):
        raise ValueError(
            f"--step={step}: the policy acted in steps 0 to {len(moments) - 1} of this episode; name one of "
            "these"
        )
    return moments[step]
