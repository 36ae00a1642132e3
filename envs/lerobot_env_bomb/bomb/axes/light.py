# pyright: reportAttributeAccessIssue=false
"""Perturbation axis `light`: intensity and direction of the light."""

from lerobot_env_bomb.bomb.axes.transform import Transform
from lerobot_env_bomb.shared.mujoco_gl import mujoco
from lerobot_env_bomb.shared.transforms import LightTransform


class Light(LightTransform, Transform):
    """Intensity and direction of the light."""

    def edit_model(self, model: mujoco.MjModel) -> None:
        lamp, headlight = model.light("key"), model.vis.headlight
        for part in (lamp.diffuse, lamp.specular, headlight.ambient, headlight.diffuse):
            part[:] *= self.factor
        lamp.dir[:] = self.turn @ lamp.dir
