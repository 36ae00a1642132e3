"""Pointing and the truth: does a policy read stone and place right, and does its next action go there?"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from lerobot_bomb.bomb.camera import PinholeCamera
from lerobot_bomb.bomb.expert import current_goal
from lerobot_bomb.bomb.move import place_name
from lerobot_bomb.bomb.observation import reach_m
from lerobot_bomb.bomb.pointing import HELD, Meant, PointedAt, action_for
from lerobot_bomb.bomb.privileged_state import PrivilegedState
from lerobot_bomb.explain.diagnosis import Finding
from lerobot_bomb.explain.scored_policy import Batch, ScoredPolicy
from lerobot_bomb.viewing.checkpoint import LoadedPolicy

SLACK_MM = 5.0  # of an action: twice the noise that demonstrations are recorded with
SLACK_SHARE = 0.5  # of the way that the expert's action would go
MARKED_PX = 448  # side of a picture with marks
RADIUS_PX, WIDTH_PX, OUTLINE_PX = 15, 2, 4
# told apart by the colour-blind (Okabe and Ito)
PLACE_RGB, STONE_RGB = (230, 159, 0), (86, 180, 233)
BLACK, WHITE = (0, 0, 0), (255, 255, 255)  # outlines; names
FONT, FONT_SCALE = cv2.FONT_HERSHEY_SIMPLEX, 0.5


@dataclass(frozen=True)
class Mark:
    """A ring where a policy points, or a cross at the true stone or place."""

    xyz: np.ndarray  # (3,) metres
    rgb: tuple[int, int, int]
    is_ring: bool
    name: str


@dataclass(frozen=True)
class PointingCheck:
    """Stone and place that a policy points at in one moment, beside the true state."""

    pointed: PointedAt
    state: PrivilegedState
    action: np.ndarray  # (D,) the next one, in the environment's units

    @property
    def meant(self) -> Meant:
        """Stone and place of the expert."""
        return Meant.in_state(self.state)

    @property
    def place(self) -> str:
        """Name of the place that is pointed at."""
        return place_name(self.pointed.place_xy)

    @property
    def meant_place(self) -> str:
        """Name of the expert's place."""
        return place_name(self.meant.place_xy)

    @property
    def place_mm(self) -> float:
        """Distance from the place that is pointed at to the expert's."""
        return 1e3 * float(np.linalg.norm(self.pointed.place_xy - self.meant.place_xy))

    @property
    def stone_mm(self) -> float:
        """Distance from where the policy sees the stone to the expert's stone."""
        return 1e3 * float(np.linalg.norm(self.pointed.stone_xy - self.meant.stone_xy))

    @property
    def is_place_right(self) -> bool:
        """Return True if both places are one intersection, or in the tray."""
        return self.place == self.meant_place

    @property
    def is_stone_right(self) -> bool:
        """Return True if the policy points at some part of the expert's stone."""
        return self.stone_mm <= 1e3 * self.state.stone_radius_m

    @property
    def way_mm(self) -> np.ndarray:
        """(2,) way of the next action, in x and y."""
        return self._way_mm(self.action)

    @property
    def asked_mm(self) -> np.ndarray:
        """(2,) motion of the expert if stone and place were where the policy points."""
        return self._way_mm(action_for(self.state, self.pointed))

    @property
    def apart_mm(self) -> float:
        """Distance from where the next action leads to where the expert's would."""
        return float(np.linalg.norm(self.way_mm - self.asked_mm))

    @property
    def goes_there(self) -> bool:
        """Return True if the next action goes where the policy points, apart from noise and speed."""
        return self.apart_mm <= max(SLACK_MM, SLACK_SHARE * float(np.linalg.norm(self.asked_mm)))

    def _way_mm(self, action: np.ndarray) -> np.ndarray:
        mode = self.state.control_mode
        start_m = self.state.gripper_xyz if mode == "absolute" else np.zeros(3)
        return 1e3 * (reach_m(action[None], mode) - start_m)[:2]

    @property
    def finding(self) -> Finding:
        """Diagnosis: does the policy misread, or does it know and not act?"""
        misread = [*self._misread()]
        verdict = f"it misreads the {' and the '.join(misread)}" if misread else "all as is meant"
        if not self.goes_there:
            verdict += "; the next action does not go there"
            verdict += "" if misread else ": it knows and does not act"
        names = (
            f"{'right' if self.is_place_right else 'wrong'} place",
            f"{'right' if self.is_stone_right else 'wrong'} stone",
            "goes there" if self.goes_there else "does not go there",
        )
        place = self.place if self.is_place_right else f"{self.place}, not {self.meant_place}"
        return Finding("It points at:", f"{place}; {verdict}", names)

    def _misread(self) -> Iterator[str]:
        if not self.is_place_right:
            yield "place"
        if not self.is_stone_right and self.meant.held < HELD:
            yield f"stone by {self.stone_mm:.0f} mm"

    @property
    def marks(self) -> list[Mark]:
        """Marks for an image; a place is as high as the stone that will lie there."""
        goal = current_goal(self.state)
        place_z, stone_z = goal.xyz[2], self.state.stone_xyz[goal.stone, 2]
        pointed, meant = self.pointed, self.meant
        return [
            Mark(np.array([*meant.stone_xy, stone_z]), STONE_RGB, False, "stone"),
            Mark(np.array([*meant.place_xy, place_z]), PLACE_RGB, False, self.meant_place),
            Mark(np.array([*pointed.stone_xy, stone_z]), STONE_RGB, True, "it points at: stone"),
            Mark(np.array([*pointed.place_xy, place_z]), PLACE_RGB, True, f"it points at: {self.place}"),
        ]

    def as_json(self) -> dict[str, Any]:
        """Return the check as JSON values, in metres and millimetres."""
        pointed, meant = self.pointed, self.meant
        return {
            "place": self.place,
            "place_xy_m": pointed.place_xy.tolist(),
            "meant_place": self.meant_place,
            "meant_place_xy_m": meant.place_xy.tolist(),
            "place_mm": self.place_mm,
            "stone_xy_m": pointed.stone_xy.tolist(),
            "meant_stone_xy_m": meant.stone_xy.tolist(),
            "stone_mm": self.stone_mm,
            "held": pointed.held,
            "meant_held": meant.held,
            "places": [{"xy_m": [*xy], "probability": probability} for xy, probability in pointed.likeliest],
            "action_mm": self.way_mm.tolist(),
            "asked_action_mm": self.asked_mm.tolist(),
            "goes_there": self.goes_there,
        }


def check_pointing(
    loaded: LoadedPolicy, scored: ScoredPolicy, observation: Batch, state: PrivilegedState | None
) -> PointingCheck | None:
    """Compare pointing and next action with the truth; None without pointing, or without a known truth."""
    if state is None:
        return None
    loaded.begin()
    prepared = loaded.prepare(observation)
    pointed = scored.pointed(prepared)
    return None if pointed is None else PointingCheck(pointed, state, loaded.act(prepared)[0])


def marked(image: np.ndarray, camera: PinholeCamera, marks: list[Mark]) -> np.ndarray:
    """(H, W, 3) uint8 -> (MARKED_PX, MARKED_PX, 3), with marks on it; crosses with their names."""
    shown = cv2.resize(image, (MARKED_PX, MARKED_PX), interpolation=cv2.INTER_NEAREST)
    scale = MARKED_PX / image.shape[0]
    for mark in marks:
        x, y = ((camera.pixel_of(mark.xyz) + 0.5) * scale - 0.5).round().astype(int).tolist()
        beside = x + RADIUS_PX + OUTLINE_PX, y + OUTLINE_PX
        for width, rgb, text_rgb in ((OUTLINE_PX, BLACK, BLACK), (WIDTH_PX, mark.rgb, WHITE)):
            if mark.is_ring:
                cv2.circle(shown, (x, y), RADIUS_PX, rgb, width, cv2.LINE_AA)
                continue
            cv2.drawMarker(shown, (x, y), rgb, cv2.MARKER_CROSS, RADIUS_PX, width, cv2.LINE_AA)
            cv2.putText(shown, mark.name, beside, FONT, FONT_SCALE, text_rgb, width - 1, cv2.LINE_AA)
    return shown
