# pyright: reportAttributeAccessIssue=false
"""Perturbation axis `distractors`: bodies beside the objects that no instruction mentions."""

from dataclasses import dataclass
from typing import Any, Self
from xml.etree import ElementTree

import numpy as np

from lerobot_bomb.conditions import MAX_LEVEL
from lerobot_bomb.libero.perturbations import libero_magnitude
from lerobot_env_bomb.libero.scene import CAMERAS, LiberoScene, LiberoTransform
from lerobot_env_bomb.libero.stock import mujoco
from lerobot_env_bomb.shared.rotations import matrix_of

MAX_COUNT = int(libero_magnitude("distractors", "count", MAX_LEVEL))
SHAPES = ("box", "cylinder", "sphere")
HALF_SIZE_M = 0.022
RGB = ((0.9, 0.5, 0.1), (0.5, 0.2, 0.7), (0.1, 0.6, 0.6), (0.9, 0.3, 0.6), (0.35, 0.6, 0.15))
CLEARANCE_M = 0.03  # from objects, fixtures and the gripper
PATH_M = 0.08  # from the straight lines between objects of the task, and from the gripper to them
REACH_M = 0.34  # from the middle of the table along x and y
SPACING_M = 0.03  # of the places that are tried
ABOVE_M = 2.0  # height from which a place is looked for downwards
BETWEEN_M = 0.07  # any two distractors
STEP_M = 0.05  # from the surface that objects stand on, at most
IN_VIEW = 0.9  # share of the scene camera's image, around its middle, that holds them


@dataclass(frozen=True)
class Distractors(LiberoTransform):
    """Fixed bodies; each level adds one and leaves the others in their places."""

    count: int
    order: tuple[float, ...]  # a number for each place, by which places are tried
    colors: tuple[int, ...]
    shapes: tuple[int, ...]

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: Any) -> Self:
        return cls(
            count=int(libero_magnitude("distractors", "count", level)),
            order=tuple(rng.random(len(_places())).tolist()),
            colors=tuple(rng.permutation(len(RGB)).tolist()),
            shapes=tuple(rng.integers(len(SHAPES), size=MAX_COUNT).tolist()),
        )

    @classmethod
    def add_bodies(cls, worldbody: ElementTree.Element) -> None:
        for number in range(MAX_COUNT):
            body = ElementTree.SubElement(worldbody, "body", name=f"distractor{number}", pos="0 0 0.5")
            for shape in SHAPES:
                ElementTree.SubElement(
                    body, "geom", name=f"distractor{number}_{shape}", type=shape,
                    size=" ".join([str(HALF_SIZE_M)] * {"box": 3, "cylinder": 2, "sphere": 1}[shape]),
                    rgba="0 0 0 0", group="1", contype="0", conaffinity="0", mass="0",
                )  # fmt: skip

    def arrange(self, scene: LiberoScene) -> None:
        model = scene.model
        mujoco.mj_forward(model, scene.data)
        boxes = list(scene.boxes().values())
        ends = [scene.data.xpos[body][:2] for body in scene.wanted_bodies()] + [scene.gripper_xyz()[:2]]
        free: list[np.ndarray] = []
        for place in _places()[np.argsort(self.order)]:
            if not _is_out_of_the_way(place, boxes, ends):
                continue
            spot = _spot_on_table(scene, place, surface_m=min(box[0, 2] for box in boxes))
            if spot is not None and all(np.linalg.norm(spot - other) > BETWEEN_M for other in free):
                free.append(spot)
            if len(free) == self.count:
                break
        for number, spot in enumerate(free):
            geom = model.geom(f"distractor{number}_{SHAPES[self.shapes[number]]}")
            model.body_pos[model.body(f"distractor{number}").id] = spot + np.array([0, 0, HALF_SIZE_M])
            geom.rgba[:] = *RGB[self.colors[number]], 1
            geom.contype[:] = geom.conaffinity[:] = 1


def _places() -> np.ndarray:
    """(n, 2) metres, x and y of the places that are tried."""
    line = np.arange(-REACH_M, REACH_M + 1e-9, SPACING_M)
    return np.stack(np.meshgrid(line, line, indexing="ij"), -1).reshape(-1, 2)


def _is_out_of_the_way(place: np.ndarray, boxes: list[np.ndarray], ends: list[np.ndarray]) -> bool:
    """Return True if a place (2,) is far from (2, 3) boxes and from the lines between the task's places."""
    gap = HALF_SIZE_M + CLEARANCE_M
    if any((place > low[:2] - gap).all() and (place < high[:2] + gap).all() for low, high in boxes):
        return False
    return all(_distance_m(place, one, other) >= PATH_M for one in ends for other in ends)


def _spot_on_table(scene: LiberoScene, place: np.ndarray, surface_m: float) -> np.ndarray | None:
    """(3,) the point of table or floor at a place, about `surface_m` high, if the scene's camera sees it."""
    model, data = scene.model, scene.data
    geom = np.zeros((1,), np.int32)
    start = np.array([*place, ABOVE_M])
    depth_m = mujoco.mj_ray(model, data, start, np.array([0.0, 0.0, -1.0]), None, 1, -1, geom)
    if depth_m < 0 or scene.owners[model.geom_bodyid[geom[0]]] != 0:
        return None
    spot = start - np.array([0, 0, depth_m])
    if abs(spot[2] - surface_m) > STEP_M or not _is_seen(scene, spot):
        return None
    return spot


def _is_seen(scene: LiberoScene, spot: np.ndarray) -> bool:
    model = scene.model
    camera = model.camera(CAMERAS[0]).id
    eye, middle = model.cam_pos[camera], spot + np.array([0, 0, HALF_SIZE_M])
    right, up, backward = (middle - eye) @ matrix_of(model.cam_quat[camera])
    slope = np.tan(np.radians(model.cam_fovy[camera]) / 2) * IN_VIEW
    if max(abs(right), abs(up)) > -backward * slope:
        return False
    distance_m = float(np.linalg.norm(middle - eye))
    geom = np.zeros((1,), np.int32)
    depth_m = mujoco.mj_ray(model, scene.data, eye, (middle - eye) / distance_m, None, 1, -1, geom)
    return depth_m < 0 or depth_m > distance_m


def _distance_m(point: np.ndarray, one: np.ndarray, other: np.ndarray) -> float:
    """Return the distance of a point from the segment between two others, (2,) each."""
    along = other - one
    share = np.clip((point - one) @ along / max(float(along @ along), 1e-12), 0, 1)
    return float(np.linalg.norm(point - one - share * along))
