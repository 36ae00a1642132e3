"""Processors of ``keypoint_probe``: LeRobot's default pipelines plus the numbers of the instruction words."""

import zlib
from dataclasses import dataclass
from typing import Any

import torch
from lerobot.processor import PolicyAction, PolicyProcessorPipeline, ProcessorStepRegistry
from lerobot.utils.constants import OBS_LANGUAGE_TOKENS
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from lerobot_bomb.vlm.task_tokenizer import TaskStep, make_task_processors
from lerobot_policy_keypoint_probe.configuration_keypoint_probe import KeypointProbeConfig

NO_WORD = 0  # fills up short instructions
NUM_WORD_IDS = 4096


def word_ids(instruction: str) -> list[int]:
    """Return a number in 1..NUM_WORD_IDS - 1 for each word between spaces, punctuation included.

    No vocabulary and no parsing: "(2," and "2)." are words like any other.
    """
    return [1 + zlib.crc32(word.encode()) % (NUM_WORD_IDS - 1) for word in instruction.split()]


@ProcessorStepRegistry.register(KeypointProbeConfig.TASK_STEP)
@dataclass
class WordsStep(TaskStep):
    """``task`` (B texts) -> ``observation.language.tokens`` (B, L) int64, rows filled up with NO_WORD."""

    def tokens(self, tasks: list[str]) -> dict[str, Tensor]:
        rows = [torch.tensor(word_ids(task), dtype=torch.int64) for task in tasks]
        return {OBS_LANGUAGE_TOKENS: pad_sequence(rows, batch_first=True, padding_value=NO_WORD)}


def make_keypoint_probe_pre_post_processors(
    config: KeypointProbeConfig, dataset_stats: dict[str, dict[str, Tensor]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Make the processors: rename, batch, words, device, normalise; and unnormalise, to CPU."""
    return make_task_processors(config, dataset_stats, WordsStep())
