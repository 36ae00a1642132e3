"""The processor step that turns an instruction into tokens, and the pipelines around it.

It reads only the task; everything else of a prompt depends on a policy's config and is put together inside
the policy.
"""

import re
from dataclasses import dataclass, field
from typing import Any

import torch
from lerobot.configs import PipelineFeatureType, PolicyFeature, PreTrainedConfig
from lerobot.processor import (
    ObservationProcessorStep,
    PolicyAction,
    PolicyProcessorPipeline,
    ProcessorStepRegistry,
    TransitionKey,
    make_default_policy_processor_steps,
    make_policy_processor_pipelines,
)
from lerobot.utils.constants import OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS
from tokenizers import Tokenizer
from torch import Tensor

from lerobot_bomb.vlm.prompt import task_ids
from lerobot_bomb.vlm.tokenizer import tokenizer_from_tensor, tokenizer_to_tensor

MAX_KEPT_TASKS = 4096
TOKENIZER_KEY = "tokenizer_json"


@ProcessorStepRegistry.register("bomb_task_tokenizer")
@dataclass
class TaskTokenizerStep(ObservationProcessorStep):
    """``task`` (B texts) -> ``observation.language.tokens`` (B, L) and their attention mask (B, L) bool.

    ``template`` is what is written, with ``{}`` for the task. The tokenizer is the step's state, so a
    checkpoint carries it whole. Rows are padded at the end. A dataset has few tasks, so their ids are kept:
    the tokenizer does not run again.
    """

    tokenizer: Tokenizer | None = field(default=None, repr=False)
    template: str = "{}"
    _ids: dict[str, Tensor] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        if not isinstance(self.template, str) or re.findall(r"[{}]+", self.template) != ["{}"]:
            raise ValueError(
                f"template={self.template!r} must hold {{}} once, for the task, and no other brace"
            )
        if not isinstance(self.tokenizer, Tokenizer | None):
            raise ValueError(
                f"tokenizer={self.tokenizer!r} must be a Tokenizer; a checkpoint has it as state"
            )

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        tasks = (self.transition.get(TransitionKey.COMPLEMENTARY_DATA) or {}).get("task")
        tasks = [tasks] if isinstance(tasks, str) else tasks
        if not tasks or not all(isinstance(task, str) for task in tasks):
            raise ValueError(f"the policy needs the instruction under the key 'task' as text; got {tasks!r}")
        rows = [self._ids_of(task) for task in tasks]
        tokens_BL = torch.nn.utils.rnn.pad_sequence(rows, batch_first=True)
        lengths_B1 = torch.tensor([[len(row)] for row in rows])
        return {
            **observation,
            OBS_LANGUAGE_TOKENS: tokens_BL,
            OBS_LANGUAGE_ATTENTION_MASK: torch.arange(tokens_BL.shape[1]) < lengths_B1,
        }

    def _ids_of(self, task: str) -> Tensor:
        if self.tokenizer is None:
            raise ValueError("the task tokenizer is empty: the checkpoint's processor state was not loaded")
        if task not in self._ids:
            if len(self._ids) == MAX_KEPT_TASKS:
                self._ids.clear()
            self._ids[task] = torch.tensor(task_ids(self.tokenizer, task, self.template), dtype=torch.int64)
        return self._ids[task]

    def get_config(self) -> dict[str, Any]:
        return {"template": self.template}

    def state_dict(self) -> dict[str, Tensor]:
        return {} if self.tokenizer is None else {TOKENIZER_KEY: tokenizer_to_tensor(self.tokenizer)}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        if state.keys() != {TOKENIZER_KEY}:
            raise ValueError(
                f"the state of bomb_task_tokenizer must be {TOKENIZER_KEY!r} alone; it is {sorted(state)}"
            )
        self.tokenizer = tokenizer_from_tensor(state[TOKENIZER_KEY])
        self._ids.clear()

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        return features


def make_task_processors(
    config: PreTrainedConfig,
    dataset_stats: dict[str, dict[str, Tensor]] | None,
    task_step: ObservationProcessorStep,
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Rename, batch, ``task_step`` (which reads the task), device, normalise; and unnormalise, to CPU."""
    steps = make_default_policy_processor_steps(config, dataset_stats)
    return make_policy_processor_pipelines(
        input_steps=[
            steps.rename_observations,
            steps.add_batch_dim,
            task_step,
            steps.to_device,
            steps.normalize,
        ],
        output_steps=[steps.unnormalize, steps.to_cpu],
    )
