"""Perturbation axis `light`: intensity and direction of the light."""

from lerobot_env_bomb.libero.scene import HEADLIGHT, LiberoScene, LiberoTransform
from lerobot_env_bomb.shared.transforms import LightTransform


class LiberoLight(LightTransform, LiberoTransform):
    """Intensity of all light, direction of the lamps."""

    def edit(self, scene: LiberoScene) -> None:
        model = scene.model
        for name in HEADLIGHT:
            getattr(model.vis.headlight, name)[:] *= self.factor
        for part in (model.light_diffuse, model.light_specular, model.light_ambient):
            part[:] *= self.factor
        model.light_dir[:] = model.light_dir @ self.turn.T
