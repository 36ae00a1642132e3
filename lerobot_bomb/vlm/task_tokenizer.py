"""Processor step that reads a batch and its instructions, and the pipelines around it.

It turns only the task into tokens; everything else of a prompt depends on a policy's config and is put
together inside the policy.
"""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from lerobot.configs import PipelineFeatureType, PolicyFeature, PreTrainedConfig
from lerobot.processor import (
    EnvTransition,
    ObservationProcessorStep,
    PolicyAction,
    PolicyProcessorPipeline,
    ProcessorStepRegistry,
    TransitionKey,
    make_default_policy_processor_steps,
    make_policy_processor_pipelines,
)
from lerobot.utils.constants import (
    ACTION,
    OBS_IMAGE,
    OBS_LANGUAGE,
    OBS_LANGUAGE_ATTENTION_MASK,
    OBS_LANGUAGE_TOKENS,
    OBS_PREFIX,
    OBS_STATE,
)
from tokenizers import Tokenizer
from torch import Tensor

from lerobot_bomb.finite import require_finite_batch, require_finite_statistics
from lerobot_bomb.vlm.prompt import check_template, task_ids
from lerobot_bomb.vlm.tokenizer import tokenizer_from_tensor, tokenizer_to_tensor

MAX_KEPT_TASKS = 4096
# inputs that are read in metres and pixels; LeRobot takes them for states
GEOMETRY = tuple(f"{OBS_PREFIX}{kind}." for kind in ("depth", "intrinsics", "extrinsics"))
TOKENIZER_KEY = "tokenizer_json"


@dataclass
class TaskStep(ObservationProcessorStep):
    """Reads the batch for all that follows: numbers as float32, a row for each instruction, all checked.

    It is in the pipelines of all our checkpoints, before anything is normalised. LeRobot's normaliser casts
    all its statistics to the type of its last input, and a checkpoint saves them like that: whole numbers
    would truncate them. Images, state and actions must be finite, images in [0, 1], and rows as many as
    instructions. On CUDA the host waits once, before the pass.
    """

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        frames = transition.get(TransitionKey.COMPLEMENTARY_DATA) or {}
        tasks, action = _read_tasks(frames), transition.get(TransitionKey.ACTION)
        observation = transition.get(TransitionKey.OBSERVATION) or {}
        observation = {key: _as_floats(key, values, len(tasks)) for key, values in observation.items()}
        action = _as_floats(ACTION, action, len(tasks))
        read = _read_by_policies(observation, action)
        _check_rows(read, len(tasks))
        require_finite_batch(read, frames)
        ready = {TransitionKey.OBSERVATION: observation, TransitionKey.ACTION: action}
        return super().__call__({**transition, **ready})  # pyright: ignore[reportArgumentType]  a TypedDict

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        tasks = _read_tasks(self.transition.get(TransitionKey.COMPLEMENTARY_DATA) or {})
        return {**observation, **self.tokens(tasks)}

    @abstractmethod
    def tokens(self, tasks: list[str]) -> dict[str, Tensor]:
        """Return the entries to add to the observation, by key: ids (B, L) and what belongs to them."""

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        return features


def _read_tasks(frames: Mapping[str, Any]) -> list[str]:
    tasks = frames.get("task")
    tasks = [tasks] if isinstance(tasks, str) else tasks
    if not tasks or not all(isinstance(task, str) for task in tasks):
        raise ValueError(f"the policy needs the instruction under the key 'task' as text; got {tasks!r}")
    return tasks


def _as_floats(key: str, values: Any, num_rows: int) -> Any:
    """Return numbers (B, ...) as float32, images and tokens as they are.

    LeRobot reads a feature of one dimension as (B,), and takes that for one vector of B: (1, B).
    """
    if not isinstance(values, Tensor) or key.startswith((OBS_IMAGE, OBS_LANGUAGE)) or key.endswith("_is_pad"):
        return values
    if num_rows > 1 and values.shape == (1, num_rows):
        values = values.T
    return values.float()


def _check_rows(values: Mapping[str, Tensor], num_tasks: int) -> None:
    for key, of_key in values.items():
        if len(of_key) != num_tasks:
            raise ValueError(
                f"the batch has {len(of_key)} rows of {key!r} and {num_tasks} instructions under 'task'; "
                f"give a text for each row"
            )


@ProcessorStepRegistry.register("bomb_task_tokenizer")
@dataclass
class TaskTokenizerStep(TaskStep):
    """``task`` (B texts) -> ``observation.language.tokens`` (B, L) and their attention mask (B, L) bool.

    ``template`` is the text to write, with ``{}`` for the task. The tokenizer is the step's state, so a
    checkpoint carries it whole. Rows are padded at the end. A dataset has few tasks, so their ids are kept:
    the tokenizer does not run again.
    """

    tokenizer: Tokenizer | None = field(default=None, repr=False)
    template: str = "{}"
    _ids: dict[str, Tensor] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        check_template(self.template, "template")
        if not isinstance(self.tokenizer, Tokenizer | None):
            raise ValueError(
                f"tokenizer={self.tokenizer!r} must be a Tokenizer; a checkpoint has it as state"
            )

    def tokens(self, tasks: list[str]) -> dict[str, Tensor]:
        rows = [self._ids_of(task) for task in tasks]
        tokens_BL = torch.nn.utils.rnn.pad_sequence(rows, batch_first=True)
        lengths_B1 = torch.tensor([[len(row)] for row in rows])
        return {
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


def _read_by_policies(observation: Mapping[str, Any], actions: Any) -> dict[str, Tensor]:
    """Return images, state and actions by key; not depth, which is not finite where it is missing."""
    return {
        key: values
        for key, values in {**observation, ACTION: actions}.items()
        if isinstance(values, Tensor) and (key in (ACTION, OBS_STATE) or key.startswith(OBS_IMAGE))
    }


def without_geometry[T](statistics: Mapping[str, T]) -> dict[str, T]:
    """Leave out the statistics of depth and cameras, so that LeRobot does not normalise those."""
    return {key: of_key for key, of_key in statistics.items() if not key.startswith(GEOMETRY)}


def make_task_processors(
    config: PreTrainedConfig,
    dataset_stats: dict[str, dict[str, Tensor]] | None,
    task_step: TaskStep,
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Make the processors: rename, batch, ``task_step``, device, normalise; and unnormalise, to CPU.

    Raises:
        ValueError: the statistics are not finite.
    """
    require_finite_statistics(dataset_stats)
    steps = make_default_policy_processor_steps(config, without_geometry(dataset_stats or {}))
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
