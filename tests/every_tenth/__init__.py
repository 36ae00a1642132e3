"""A policy that raises in every tenth episode that its process runs; not installed: a plugin by its path."""

from every_tenth.configuration_every_tenth import EveryTenthConfig
from every_tenth.processor_every_tenth import make_every_tenth_pre_post_processors

__all__ = ["EveryTenthConfig", "make_every_tenth_pre_post_processors"]
