"""An episode as a recording for the viewer of Rerun: cameras, the scene in 3-D, curves, words."""

from pathlib import Path
from typing import Self

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from lerobot_bomb.bomb.board import BOARD, COLORS
from lerobot_bomb.bomb.episode import EpisodeSpec, Stage
from lerobot_bomb.bomb.observation import ACTION_NAMES, AGENT_POS, CAMERAS, PIXELS, STATE_NAMES
from lerobot_bomb.bomb.privileged_state import PrivilegedState
from lerobot_bomb.envs.results import EpisodeResult
from lerobot_bomb.envs.rollout import Moment

APPLICATION = "lerobot_bomb"
STEP, TIME = "step", "time"  # the timelines: control steps, seconds

STONE_RGB = {"black": (25, 25, 28), "white": (240, 240, 235)}
BOARD_RGB, LINE_RGB = (216, 168, 104), (46, 30, 16)
TARGET_RGB, GRIPPER_RGB, TRACE_RGB = (0, 150, 70), (220, 60, 40), (60, 110, 220)
LINE_RADIUS_M, TRACE_RADIUS_M, GRIPPER_RADIUS_M = 0.0007, 0.0010, 0.0040
TARGET_RADIUS_M = 1.2 * BOARD.stone_radius_m  # a ring that a stone on the target does not hide
EYE_M, LOOK_AT_M = (0.05, -0.30, 0.28), (0.05, 0.0, 0.03)  # in front of the board
CURVE_RGB = ((230, 75, 60), (70, 180, 90), (80, 140, 240), (240, 180, 50))  # x, y, z, fingers


class RerunFile:
    """Writes moments of one episode to an .rrd, on the timelines `step` and `time`."""

    def __init__(self, path: Path, spec: EpisodeSpec, name: str) -> None:
        self._spec = spec
        self._trace: list[np.ndarray] = []
        self._stage = ""
        self._recording = rr.RecordingStream(APPLICATION)
        self._recording.save(path, default_blueprint=layout(spec.fps))
        self._recording.send_recording_name(name)
        self._log("scene", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._log_board()
        for entity, names in (("action", ACTION_NAMES[spec.control_mode]), ("state", STATE_NAMES)):
            for name, color in zip(names, CURVE_RGB, strict=True):
                self._log(f"{entity}/{name}", rr.SeriesLines(colors=[color], names=[name]), static=True)

    def add(self, moment: Moment) -> None:
        """Log one moment; the instruction and the target with the first."""
        state = moment.state
        if moment.step == 0:
            self._log("instruction", rr.TextDocument(moment.instruction), static=True)
            self._log_target(state)
        self._set_step(moment.step)
        for camera in CAMERAS:
            self._log(f"camera/{camera}", _png(moment.observation[PIXELS][camera]))
        self._log_scene(state)
        self._log_values("state", STATE_NAMES, moment.observation[AGENT_POS])
        if moment.action is not None:
            self._log_values("action", ACTION_NAMES[self._spec.control_mode], moment.action)
        self._log("placement_error_mm", rr.Scalars(float(moment.info["placement_error_mm"])))
        if moment.info["stage"] != self._stage:
            self._stage = moment.info["stage"]
            self._log("stage", rr.TextLog(self._stage))

    def add_result(self, result: EpisodeResult) -> None:
        """Log, at the last step, what became of the episode."""
        self._set_step(result.steps)
        self._log("result", rr.TextDocument(describe_result(result)))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._recording.flush()
        self._recording.disconnect()

    def _log(self, entity: str, what: rr.AsComponents, static: bool = False) -> None:
        self._recording.log(entity, what, static=static, strict=True)

    def _set_step(self, step: int) -> None:
        self._recording.set_time(STEP, sequence=step)
        self._recording.set_time(TIME, duration=step / self._spec.fps)

    def _log_values(self, entity: str, names: tuple[str, ...], values: np.ndarray) -> None:
        for name, value in zip(names, values, strict=True):
            self._log(f"{entity}/{name}", rr.Scalars(float(value)))

    def _log_board(self) -> None:
        half_m, thickness_m = BOARD.half_size_m, BOARD.thickness_m
        wood = rr.Boxes3D(
            centers=[[0, 0, thickness_m / 2]],
            half_sizes=[[half_m, half_m, thickness_m / 2]],
            colors=[BOARD_RGB],
            fill_mode="solid",
        )
        self._log("scene/board", wood, static=True)
        corners = [BOARD.intersection_xy(*cell) for cell in ((0, 0), (BOARD.num_lines - 1,) * 2)]
        (left, far), (right, near) = corners
        strips = []
        for line in range(BOARD.num_lines):
            x, y = BOARD.intersection_xy(line, line)
            strips += [[(left, y, thickness_m), (right, y, thickness_m)]]
            strips += [[(x, near, thickness_m), (x, far, thickness_m)]]
        lines = rr.LineStrips3D(strips, radii=LINE_RADIUS_M, colors=[LINE_RGB])
        self._log("scene/board/lines", lines, static=True)

    def _log_target(self, state: PrivilegedState) -> None:
        angles_rad = np.linspace(0, 2 * np.pi, 49)
        ring = np.stack([np.cos(angles_rad), np.sin(angles_rad), np.zeros_like(angles_rad)], axis=1)
        center = np.array([*state.goals[0].xyz[:2], BOARD.thickness_m + LINE_RADIUS_M])
        row, column = BOARD.nearest_intersection(state.goals[0].xyz[:2])
        self._log(
            "scene/target",
            rr.LineStrips3D(
                [center + TARGET_RADIUS_M * ring],
                radii=TRACE_RADIUS_M,
                colors=[TARGET_RGB],
                labels=[f"target: row {row}, column {column}"],
            ),
            static=True,
        )

    def _log_scene(self, state: PrivilegedState) -> None:
        in_play = state.stone_in_play
        colors = [STONE_RGB[COLORS[int(is_white)]] for is_white in state.stone_is_white[in_play]]
        # a stone's goal is to lie on the board
        half_height_m = float(state.goals[0].xyz[2]) - BOARD.thickness_m
        half_size = (state.stone_radius_m, state.stone_radius_m, half_height_m)
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


def layout(fps: int) -> rrb.Blueprint:
    """What the viewer shows when it opens a recording of `fps` steps per second."""
    eye = rrb.EyeControls3D(position=EYE_M, look_target=LOOK_AT_M, eye_up=(0.0, 0.0, 1.0))
    cameras = [rrb.Spatial2DView(origin=f"camera/{camera}", name=camera) for camera in CAMERAS]
    words = [
        rrb.TextDocumentView(origin="instruction", name="instruction"),
        rrb.TextLogView(origin="stage", name="stage"),
        rrb.TextDocumentView(origin="result", name="result"),
    ]
    curves = [
        rrb.TimeSeriesView(origin=name, name=name) for name in ("action", "state", "placement_error_mm")
    ]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(*cameras),
            rrb.Vertical(
                rrb.Spatial3DView(origin="scene", name="scene", eye_controls=eye),
                rrb.Horizontal(*words),
                row_shares=[3, 1],
            ),
            rrb.Vertical(*curves),
            column_shares=[1, 2, 1.3],
        ),
        rrb.TimePanel(state="collapsed", timeline=STEP, fps=fps),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def describe_result(result: EpisodeResult) -> str:
    """One line: success or the class of failure, steps, placement error, where the stone is."""
    outcome = "success" if result.is_success else f"failed: {result.failure}"
    row, column = result.nearest_intersection
    is_carried = Stage(result.stage) in (Stage.LIFTED, Stage.PLACED)
    place = f"nearest to row {row}, column {column}" if is_carried else "never lifted"
    return (
        f"{outcome} after {result.steps} steps; the stone is {result.placement_error_mm:.1f} mm from the "
        f"target, {place}"
    )


def _png(image: np.ndarray) -> rr.EncodedImage:
    """(H, W, 3) uint8 without loss, in a third of its size."""
    _, png = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    return rr.EncodedImage(contents=png.tobytes(), media_type="image/png")
