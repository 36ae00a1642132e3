# pyright: reportAttributeAccessIssue=false
"""Transforms of a compiled model, the same for every environment on MuJoCo."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np

from lerobot_bomb.bomb.perturbations import magnitude
from lerobot_bomb.conditions import Axis, magnitude_of
from lerobot_bomb.envs.perturbation import EpisodeTransform
from lerobot_env_bomb.shared.mujoco_gl import mujoco
from lerobot_env_bomb.shared.rotations import matrix_of, quaternion_of, rotation


@dataclass(frozen=True)
class LightTransform(EpisodeTransform):
    """Intensity and direction of the light; every environment's magnitudes are BOMB's."""

    factor: float
    axis: tuple[float, float, float]  # that a lamp's direction turns around
    angle_rad: float

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: Any) -> Self:
        factor = magnitude("light", ("dim", "bright")[rng.integers(2)], level)
        azimuth_rad = rng.uniform(-np.pi, np.pi)
        axis = (float(np.cos(azimuth_rad)), float(np.sin(azimuth_rad)), 0.0)
        return cls(factor, axis, float(np.radians(magnitude("light", "tilt", level))))

    @property
    def turn(self) -> np.ndarray:
        """(3, 3) rotation of a lamp's direction."""
        return rotation(np.array(self.axis), self.angle_rad)


@dataclass(frozen=True)
class CameraTransform(EpisodeTransform):
    """Pose and field of view of a scene's camera and of one on the wrist."""

    axes: ClassVar[Mapping[str, Axis]]  # the environment's table
    angle_rad: float
    wrist_angle_rad: float
    direction_rad: float  # in the image, that the cameras swing to
    fov_factor: float
    distance_factor: float

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: Any) -> Self:
        def at(name: str) -> float:
            return magnitude_of(cls.axes, "camera", name, level)

        signs = rng.choice((-1.0, 1.0), 2)
        return cls(
            angle_rad=float(np.radians(at("angle"))),
            wrist_angle_rad=float(np.radians(at("wrist_angle"))),
            direction_rad=float(rng.uniform(-np.pi, np.pi)),
            fov_factor=1 + float(signs[0]) * at("fov"),
            distance_factor=1 + float(signs[1]) * at("distance"),
        )

    def swing(self, camera: Any, pivot: np.ndarray, angle_rad: float) -> None:
        """Turn a named camera's pose around a point of its body's frame."""
        matrix = matrix_of(camera.quat)
        axis = np.cos(self.direction_rad) * matrix[:, 0] + np.sin(self.direction_rad) * matrix[:, 1]
        turn = rotation(axis, angle_rad)
        camera.pos[:] = pivot + turn @ (camera.pos - pivot)
        camera.quat[:] = quaternion_of(turn @ matrix)


def least_distance(
    offsets: np.ndarray, camera_from_world: np.ndarray, fovy_deg: float, margin: float
) -> float:
    """Metres from a pivot at which a square image shows all (n, 3) offsets from it.

    `margin`: share of half the image, from its edge to the nearest of them.
    """
    right, up, backward = camera_from_world @ offsets.T
    slope = np.tan(np.radians(fovy_deg) / 2) * (1 - margin)
    return float(np.max(backward + np.maximum(abs(right), abs(up)) / slope))


def scale_mass(model: mujoco.MjModel, bodies: Sequence[int], factor: float) -> None:
    """Scale the mass of free bodies without children, and all that the compiler computed from it."""
    dofs = np.isin(model.dof_bodyid, bodies)
    for values in (model.body_mass, model.body_inertia, model.body_subtreemass):
        values[bodies] *= factor
    model.body_invweight0[bodies] /= factor
    model.dof_invweight0[dofs] /= factor
