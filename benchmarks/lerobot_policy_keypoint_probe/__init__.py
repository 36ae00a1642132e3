"""Keypoint probe: a small policy that asks what BOMB's demonstrations teach in minutes on a CPU."""

from lerobot_policy_keypoint_probe.configuration_keypoint_probe import KeypointProbeConfig
from lerobot_policy_keypoint_probe.processor_keypoint_probe import make_keypoint_probe_pre_post_processors

__all__ = ["KeypointProbeConfig", "make_keypoint_probe_pre_post_processors"]
