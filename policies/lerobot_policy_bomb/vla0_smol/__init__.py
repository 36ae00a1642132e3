"""VLA-0-Smol: a stock vision-language model fine-tuned to write the next actions as decimal integers."""

from lerobot_policy_bomb.vla0_smol.configuration_vla0_smol import Vla0SmolConfig
from lerobot_policy_bomb.vla0_smol.processor_vla0_smol import make_vla0_smol_pre_post_processors

__all__ = ["Vla0SmolConfig", "make_vla0_smol_pre_post_processors"]
