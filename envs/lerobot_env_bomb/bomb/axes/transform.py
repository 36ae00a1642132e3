# pyright: reportAttributeAccessIssue=false
"""Base of the perturbation axes: a transform of an episode, frozen once drawn."""

from lerobot_bomb.bomb.layout import Layout
from lerobot_bomb.envs.perturbation import EpisodeTransform
from lerobot_env_bomb.shared.mujoco_gl import mujoco


class Transform(EpisodeTransform):
    """Effect of one axis on an episode of BOMB."""

    def edit_model(self, model: mujoco.MjModel) -> None:
        """Change the compiled model in place."""

    def arrange(self, layout: Layout, supply: tuple[int, ...]) -> Layout:
        """Return the changed layout; `supply`: indices of the stones in the tray."""
        return layout
