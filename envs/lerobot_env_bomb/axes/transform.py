# pyright: reportAttributeAccessIssue=false
"""What every perturbation axis is: a transform of an episode, frozen once drawn."""

from lerobot_bomb.bomb.layout import Layout
from lerobot_bomb.envs.perturbation import EpisodeTransform
from lerobot_env_mujoco.mujoco_gl import mujoco


class Transform(EpisodeTransform):
    """What one axis does to an episode of BOMB."""

    def edit_model(self, model: mujoco.MjModel) -> None:
        """Change the compiled model in place."""

    def arrange(self, layout: Layout, supply: tuple[int, ...]) -> Layout:
        """The layout after the change; `supply`: indices of the stones in the tray."""
        return layout
