"""FDVLA: Qwen2.5-VL reads noisy actions; a flow head and a denoising head turn them into actions together."""

from lerobot_policy_bomb.fdvla.configuration_fdvla import FdvlaConfig
from lerobot_policy_bomb.fdvla.processor_fdvla import make_fdvla_pre_post_processors

__all__ = ["FdvlaConfig", "make_fdvla_pre_post_processors"]
