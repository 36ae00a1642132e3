"""Interventions: deliberate changes of a policy's inputs, to see what its actions depend on.

An intervention is a processor step at the head of a checkpoint's preprocessor. LeRobot's own commands
run the changed checkpoint, so it works for every policy type and every environment.
"""

import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.processor import (
    ComplementaryDataProcessorStep,
    DataProcessorPipeline,
    ObservationProcessorStep,
    ProcessorStep,
    ProcessorStepRegistry,
)
from lerobot.utils.constants import OBS_IMAGE, POLICY_PREPROCESSOR_DEFAULT_NAME
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_bomb.checkpoints.names import BLANK_IMAGES, REPLACE_TASKS
from lerobot_bomb.checkpoints.shipped import checkpoint_path
from lerobot_bomb.files import check_new_folder, written_whole

PREPROCESSOR_FILE = f"{POLICY_PREPROCESSOR_DEFAULT_NAME}.json"

type Features = dict[PipelineFeatureType, dict[str, PolicyFeature]]


@ProcessorStepRegistry.register(BLANK_IMAGES)
@dataclass
class BlankImages(ObservationProcessorStep):
    """Intervention in which every camera shows black."""

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        return {
            key: torch.zeros_like(value) if key.startswith(OBS_IMAGE) else value
            for key, value in observation.items()
        }

    def transform_features(self, features: Features) -> Features:
        return features


@ProcessorStepRegistry.register(REPLACE_TASKS)
@dataclass
class ReplaceTasks(ComplementaryDataProcessorStep):
    """Intervention in which the policy gets another instruction; one without a replacement is an error."""

    replacements: dict[str, str]  # instruction -> what the policy is given instead

    def __post_init__(self) -> None:
        if not isinstance(self.replacements, dict) or not self.replacements:
            raise ValueError(f"replacements={self.replacements!r} must map instructions to instructions")

    def complementary_data(self, complementary_data: dict[str, Any]) -> dict[str, Any]:
        task = complementary_data["task"]
        replaced = self._replaced(task) if isinstance(task, str) else [*map(self._replaced, task)]
        return {**complementary_data, "task": replaced}

    def _replaced(self, task: str) -> str:
        if task not in self.replacements:
            raise ValueError(
                f"the instruction {task!r} has no replacement; there are: {sorted(self.replacements)}"
            )
        return self.replacements[task]

    def get_config(self) -> dict[str, Any]:
        return asdict(self)

    def transform_features(self, features: Features) -> Features:
        return features


def intervene(checkpoint: Path | str, steps: Sequence[ProcessorStep], output: Path | str) -> None:
    """Write `output`: a copy of a checkpoint (folder or `bomb:NAME`), with `steps` before its preprocessor.

    Raises:
        ValueError: `checkpoint` is no checkpoint, `output` exists, or there are no steps.
    """
    checkpoint, output = Path(checkpoint_path(str(checkpoint))), Path(output)
    if not steps or not all(isinstance(step, ProcessorStep) for step in steps):
        raise ValueError(f"steps={steps!r} must be a list of processor steps, as [BlankImages()]")
    unknown = [type(step).__name__ for step in steps if not hasattr(type(step), "_registry_name")]
    if unknown:
        raise ValueError(
            f"{unknown[0]} is not registered, so no command could load it: give it a name with "
            "ProcessorStepRegistry.register, in a plugin that LeRobot imports"
        )
    if not (checkpoint / PREPROCESSOR_FILE).is_file():
        raise ValueError(f"{checkpoint} holds no {PREPROCESSOR_FILE}, so it is no checkpoint of a policy")
    check_new_folder("output", output)
    register_third_party_plugins()  # the checkpoint's own steps
    preprocessor = DataProcessorPipeline.from_pretrained(checkpoint, config_filename=PREPROCESSOR_FILE)
    preprocessor.steps = [*steps, *preprocessor.steps]
    with written_whole(output) as (folder,):
        others = shutil.ignore_patterns(f"{POLICY_PREPROCESSOR_DEFAULT_NAME}*")
        shutil.copytree(checkpoint, folder, ignore=others)
        preprocessor.save_pretrained(folder, config_filename=PREPROCESSOR_FILE)
