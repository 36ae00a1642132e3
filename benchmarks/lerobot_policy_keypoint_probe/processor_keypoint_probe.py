"""Processors of ``keypoint_probe``: LeRobot's default pipelines plus the numbers of the instruction words."""

import zlib
from dataclasses import dataclass
from typing import Any

import torch
from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.processor import (
    ObservationProcessorStep,
    PolicyAction,
    PolicyProcessorPipeline,
    ProcessorStepRegistry,
    TransitionKey,
)
from lerobot.utils.constants import OBS_LANGUAGE_TOKENS
from torch import Tensor

from lerobot_bomb.vlm.task_tokenizer import make_task_processors
from lerobot_policy_keypoint_probe.configuration_keypoint_probe import KeypointProbeConfig

NO_WORD = 0  # fills up short instructions
NUM_WORD_IDS = 4096


def word_ids(instruction: str) -> list[int]:
    """Numbers in 1..NUM_WORD_IDS - 1 of what stands between spaces, punctuation included.

    No vocabulary and no parsing: "(2," and "2)." are words like any other.
    """
    return [1 + zlib.crc32(word.encode()) % (NUM_WORD_IDS - 1) for word in instruction.split()]


@ProcessorStepRegistry.register(KeypointProbeConfig.TASK_STEP)
@dataclass
class WordsStep(ObservationProcessorStep):
    """``task`` (B texts) -> ``observation.language.tokens`` (B, L) int64, rows filled up with NO_WORD."""

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        tasks = (self.transition.get(TransitionKey.COMPLEMENTARY_DATA) or {}).get("task")
        tasks = [tasks] if isinstance(tasks, str) else tasks
        if not tasks or not all(isinstance(task, str) for task in tasks):
            raise ValueError(
                f"keypoint_probe needs the instruction under the key 'task' as text; got {tasks!r}"
            )
        rows = [torch.tensor(word_ids(task), dtype=torch.int64) for task in tasks]
        tokens_BL = torch.nn.utils.rnn.pad_sequence(rows, batch_first=True, padding_value=NO_WORD)
        return {**observation, OBS_LANGUAGE_TOKENS: tokens_BL}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        return features


def make_keypoint_probe_pre_post_processors(
    config: KeypointProbeConfig, dataset_stats: dict[str, dict[str, Tensor]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Rename, batch, words, device, normalise; and unnormalise, to CPU."""
    return make_task_processors(config, dataset_stats, WordsStep())
