"""An episode of BOMB as a recording for the viewer of Rerun: cameras, the scene in 3-D, curves, words."""

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from lerobot_bomb.bomb.board import BOARD, COLORS
from lerobot_bomb.bomb.episode import EpisodeSpec, Stage
from lerobot_bomb.bomb.move import place_name
from lerobot_bomb.bomb.observation import ACTION_NAMES, AGENT_POS, CAMERAS, PIXELS, state_names
from lerobot_bomb.bomb.privileged_state import PrivilegedState
from lerobot_bomb.envs.rollout import Moment
from lerobot_bomb.results.bomb import PUT_DOWN, EpisodeResult
from lerobot_bomb.viewing.rerun_file import EpisodeLog, curve_views, describe_outcome, png, text_views

STONE_RGB = {"black": (25, 25, 28), "white": (240, 240, 235)}
BOARD_RGB, LINE_RGB = (216, 168, 104), (46, 30, 16)
TARGET_RGB, GRIPPER_RGB, TRACE_RGB = (0, 150, 70), (220, 60, 40), (60, 110, 220)
LINE_RADIUS_M, TRACE_RADIUS_M, GRIPPER_RADIUS_M = 0.0007, 0.0010, 0.0040
TARGET_RADIUS_M = 1.2 * BOARD.stone_radius_m  # a ring that a stone on the target does not hide
EYE_M, LOOK_AT_M = (0.05, -0.30, 0.28), (0.05, 0.0, 0.03)  # in front of the board


class BombLog(EpisodeLog[EpisodeSpec, EpisodeResult]):
    """Log of an episode of BOMB: both cameras, the scene, the arm's motion."""

    def __init__(self, recording: rr.RecordingStream, prefix: str, spec: EpisodeSpec) -> None:
        super().__init__(recording, prefix, spec)
        self._trace: list[np.ndarray] = []
        self._stage = ""
        self._log("scene", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._log_board()

    @staticmethod
    def describe(result: EpisodeResult) -> str:
        outcome = describe_outcome(result.is_success, result.failure, result.steps)
        row, column = result.nearest_intersection
        place = ""  # of a stone that was not put down, and may lie off the board
        if Stage(result.stage) not in (Stage.LIFTED, Stage.PLACED):
            place = ", never lifted"
        elif result.placement_error_mm == 0:  # of an area: no stone lies exactly on an intersection
            place = ", in the tray"
        elif result.failure in PUT_DOWN:
            place = f", nearest to row {row}, column {column}"
        moves = "" if result.target else f"{result.progress:.0%} of the moves made; "
        return f"{outcome}; {moves}the stone is {result.placement_error_mm:.1f} mm from the target{place}"

    @staticmethod
    def layout(prefix: str) -> rrb.Horizontal:
        """Lay out cameras at the left, the scene over the words, curves at the right."""
        eye = rrb.EyeControls3D(position=EYE_M, look_target=LOOK_AT_M, eye_up=(0.0, 0.0, 1.0))
        cameras = [rrb.Spatial2DView(origin=f"{prefix}camera/{camera}", name=camera) for camera in CAMERAS]
        instruction, result = text_views(prefix, "instruction", "result")
        words = [instruction, rrb.TextLogView(origin=f"{prefix}stage", name="stage"), result]
        return rrb.Horizontal(
            rrb.Vertical(*cameras),
            rrb.Vertical(
                rrb.Spatial3DView(origin=f"{prefix}scene", name="scene", eye_controls=eye),
                rrb.Horizontal(*words),
                row_shares=[3, 1],
            ),
            rrb.Vertical(*curve_views(prefix, "action", "state", "placement_error_mm")),
            column_shares=[1, 2, 1.3],
        )

    @staticmethod
    def _timing_and_curves(spec: EpisodeSpec) -> tuple[int, dict[str, tuple[str, ...]]]:
        return spec.fps, {"action": ACTION_NAMES[spec.control_mode], "state": state_names(spec.control_mode)}

    def _log_still(self, moment: Moment) -> None:
        self._log_targets(moment.state)

    def _log_moment(self, moment: Moment) -> None:
        for camera in CAMERAS:
            self._log(f"camera/{camera}", png(moment.observation[PIXELS][camera]))
        self._log_scene(moment.state)
        self._log_values("state", moment.observation[AGENT_POS])
        self._log("placement_error_mm", rr.Scalars(float(moment.info["placement_error_mm"])))
        if moment.info["stage"] != self._stage:
            self._stage = moment.info["stage"]
            self._log("stage", rr.TextLog(self._stage))

    def _log_board(self) -> None:
        half_m, thickness_m = BOARD.half_size_m, BOARD.thickness_m
        wood = rr.Boxes3D(
            centers=[[0, 0, thickness_m / 2]],
            half_sizes=[[half_m, half_m, thickness_m / 2]],
            colors=[BOARD_RGB],
            fill_mode="solid",
        )
        self._log("scene/board", wood, static=True)
        corners = [
            BOARD.intersection_xy(*intersection) for intersection in ((0, 0), (BOARD.num_lines - 1,) * 2)
        ]
        (left, far), (right, near) = corners
        strips = []
        for line in range(BOARD.num_lines):
            x, y = BOARD.intersection_xy(line, line)
            strips += [[(left, y, thickness_m), (right, y, thickness_m)]]
            strips += [[(x, near, thickness_m), (x, far, thickness_m)]]
        lines = rr.LineStrips3D(strips, radii=LINE_RADIUS_M, colors=[LINE_RGB])
        self._log("scene/board/lines", lines, static=True)

    def _log_targets(self, state: PrivilegedState) -> None:
        angles_rad = np.linspace(0, 2 * np.pi, 49)
        ring = np.stack([np.cos(angles_rad), np.sin(angles_rad), np.zeros_like(angles_rad)], axis=1)
        xy = list(dict.fromkeys(tuple(goal.xyz[:2].tolist()) for goal in state.goals))
        centers = [np.array([*place, BOARD.thickness_m + LINE_RADIUS_M]) for place in xy]
        self._log(
            "scene/target",
            rr.LineStrips3D(
                [center + TARGET_RADIUS_M * ring for center in centers],
                radii=TRACE_RADIUS_M,
                colors=[TARGET_RGB] * len(centers),
                labels=[describe_place(np.array(place)) for place in xy],
            ),
            static=True,
        )

    def _log_scene(self, state: PrivilegedState) -> None:
        in_play = state.stone_in_play
        colors = [STONE_RGB[COLORS[int(is_white)]] for is_white in state.stone_is_white[in_play]]
        half_size = (state.stone_radius_m, state.stone_radius_m, state.stone_half_height_m)
        stones = rr.Ellipsoids3D(
            centers=state.stone_xyz[in_play],
            half_sizes=[half_size] * len(colors),
            colors=colors,
            fill_mode="solid",
        )
        self._log("scene/stones", stones)
        self._trace.append(state.gripper_xyz)
        gripper = rr.Points3D([state.gripper_xyz], radii=GRIPPER_RADIUS_M, colors=[GRIPPER_RGB])
        self._log("scene/gripper", gripper)
        trace = rr.LineStrips3D([np.array(self._trace)], radii=TRACE_RADIUS_M, colors=[TRACE_RGB])
        self._log("scene/trace", trace)


def describe_place(xy: np.ndarray) -> str:
    """Describe a target as 'target: row 1, column 3', or the tray."""
    return f"target: {place_name(xy)}"
