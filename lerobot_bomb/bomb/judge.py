"""Follows an episode and says how it stands and how it ended: one stone onto one intersection."""

import math

import numpy as np

from lerobot_bomb.bomb.board import BOARD, NUM_STONES
from lerobot_bomb.bomb.episode import Failure, Stage
from lerobot_bomb.bomb.layout import Snapshot
from lerobot_bomb.bomb.suite import Episode

REST_S = 0.5  # a stone that was carried and then rests this long ends the episode
REST_SPEED_M_S = 0.005  # below it a stone rests
LIFT_M = 0.010  # above its resting height a held stone counts as lifted
FLAT_TOLERANCE_M = 0.003  # of the height at rest; a stone that leans or lies on another one is higher
DROP_HEIGHT_M = 0.030  # a stone let go higher than this above the board was dropped, not placed
OFF_BOARD_M = 0.75 * BOARD.pitch_m  # from the nearest intersection
COLLATERAL_TOLERANCE_MM = 10.0
V0_TOLERANCE_MM = 26.0  # of the original benchmark's rule


class Judge:
    """State of one episode, updated with a snapshot after every control step.

    Success: the commanded stone, no longer touched and at rest for `REST_S`, lies flat on the target
    intersection within the spec's tolerance, and no other stone was moved by more than 10 mm.
    """

    def __init__(self, episode: Episode, fps: int, start: Snapshot):
        self.stage = Stage.START
        self.failure: Failure | None = None
        self.is_success = False
        self.is_success_bomb_v0 = False
        self.collateral_mm = 0.0
        self._episode = episode
        self._stone = episode.stone
        self._fps = fps
        self._start = start
        self._now = start
        self._was_lifted: np.ndarray = np.zeros(NUM_STONES, dtype=bool)
        self._last_touched_z = start.stone_xyz[:, 2].copy()
        self._rest_steps = np.zeros(NUM_STONES, dtype=int)

    @property
    def placement_error_mm(self) -> float:
        """Horizontal distance of the commanded stone from the target."""
        return 1e3 * float(np.linalg.norm((self._now.stone_xyz[self._stone] - self._episode.target_xyz)[:2]))

    @property
    def nearest_intersection(self) -> tuple[int, int]:
        """(row, column) of the intersection nearest to the commanded stone."""
        return BOARD.nearest_intersection(self._now.stone_xyz[self._stone, :2])

    def update(self, now: Snapshot) -> bool:
        """Take in the state after a control step; whether the episode has ended."""
        touched = now.stone_touched[:, 0] | now.stone_touched[:, 1]
        held = now.stone_touched[:, 0] & now.stone_touched[:, 1]
        step_m = now.stone_xyz - self._now.stone_xyz
        speed_m_s = np.sqrt((step_m**2).sum(axis=1)) * self._fps
        self._rest_steps = np.where(~touched & (speed_m_s < REST_SPEED_M_S), self._rest_steps + 1, 0)
        is_high: np.ndarray = now.stone_xyz[:, 2] > self._episode.layout.rest_height_m + LIFT_M
        self._was_lifted = self._was_lifted | (held & is_high)
        self._last_touched_z[touched] = now.stone_xyz[touched, 2]
        self._now = now
        moved_mm = 1e3 * np.linalg.norm(now.stone_xyz - self._start.stone_xyz, axis=1)
        self.collateral_mm = max(self.collateral_mm, float(np.delete(moved_mm, self._stone).max()))
        self._update_stage(bool(held[self._stone]))

        carried = self._was_lifted.copy()
        # a stone that was pushed, not carried, onto the target lies on the target all the same
        carried[self._stone] |= self._is_on_target()
        ended = carried & (self._rest_steps >= math.ceil(REST_S * self._fps))
        if ended[self._stone]:
            self._judge_placement()
        elif ended.any():
            self.failure = Failure.WRONG_STONE
        return bool(ended.any())

    def time_out(self) -> None:
        """Say why the episode, which has not ended by itself, failed."""
        touched = self._now.stone_touched[self._stone]
        if self._was_lifted.any() and not self._was_lifted[self._stone]:
            self.failure = Failure.WRONG_STONE
        elif self.stage is Stage.START:
            self.failure = Failure.NEVER_REACHED
        elif touched.all() or (self._was_lifted[self._stone] and (touched.any() or self._is_on_target())):
            self.failure = Failure.TIMEOUT_HOLDING
        else:
            self.failure = Failure.DROPPED if self._was_lifted[self._stone] else Failure.MISSED_GRASP

    def _update_stage(self, is_held: bool) -> None:
        offset = self._now.gripper_xyz - self._now.stone_xyz[self._stone]
        layout = self._episode.layout
        is_beside = np.linalg.norm(offset[:2]) < layout.stone_radius_m
        is_around = is_beside and offset[2] < layout.stone_height_m / 2
        reached = {
            Stage.REACHED: is_around,
            Stage.GRASPED: is_held,
            Stage.LIFTED: self._was_lifted[self._stone],
        }
        order = list(Stage)
        for stage, is_reached in reached.items():
            if is_reached and order.index(stage) > order.index(self.stage):
                self.stage = stage

    def _is_flat(self) -> bool:
        return bool(
            abs(self._now.stone_xyz[self._stone, 2] - self._episode.layout.rest_height_m) < FLAT_TOLERANCE_M
        )

    def _is_on_target(self) -> bool:
        return bool(self._is_flat() and self.placement_error_mm <= self._episode.spec.success_tolerance_mm)

    def _judge_placement(self) -> None:
        is_target = self.nearest_intersection == self._episode.target
        is_near = self.placement_error_mm <= V0_TOLERANCE_MM
        self.is_success_bomb_v0 = is_target and self._is_flat() and is_near
        if self._is_on_target():
            self.stage = Stage.PLACED
            self.is_success = self.collateral_mm <= COLLATERAL_TOLERANCE_MM
            self.failure = None if self.is_success else Failure.DISTURBED_OTHERS
        elif self._was_dropped():
            self.failure = Failure.DROPPED
        else:
            self.failure = Failure.IMPRECISE if is_target else Failure.WRONG_INTERSECTION

    def _was_dropped(self) -> bool:
        xy = self._now.stone_xyz[self._stone, :2]
        off_m = np.linalg.norm(xy - BOARD.intersection_xy(*self.nearest_intersection))
        return bool(
            off_m > OFF_BOARD_M
            or self._last_touched_z[self._stone] > self._episode.layout.rest_height_m + DROP_HEIGHT_M
        )
