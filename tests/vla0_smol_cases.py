"""Small policies and batches of ``vla0_smol`` that several test modules use."""

from typing import Any

import torch
from lerobot.configs import FeatureType, PolicyFeature
from variants import layers_of

from lerobot_bomb.actions.text import NumberTokens
from lerobot_policy_bomb.vla0_smol import Vla0SmolConfig, make_vla0_smol_pre_post_processors
from lerobot_policy_bomb.vla0_smol.modeling_vla0_smol import Vla0SmolPolicy

WORKSPACE, WRIST = "observation.images.workspace", "observation.images.wrist"
TASK = "Place a black stone on the Go board at row {}, column 1."
# literal statistics: state and action in [-1, 1] stay as they are
STATS = {
    key: {"min": torch.full((4,), -1.0), "max": torch.full((4,), 1.0)}
    for key in ("observation.state", "action")
}


def make_config(cameras: tuple[str, ...] = (WORKSPACE, WRIST), **options: Any) -> Vla0SmolConfig:
    inputs = {key: PolicyFeature(FeatureType.VISUAL, (3, 64, 64)) for key in cameras}
    inputs["observation.state"] = PolicyFeature(FeatureType.STATE, (4,))
    return Vla0SmolConfig(
        **{
            "vlm_model_name": "nano",
            "device": "cpu",
            "chunk_size": 3,
            "n_action_steps": 2,
            "input_features": inputs,
            "output_features": {"action": PolicyFeature(FeatureType.ACTION, (4,))},
            **layers_of(options),
            **options,
        }
    )


def make_policy(**options: Any) -> Vla0SmolPolicy:
    torch.manual_seed(0)
    return Vla0SmolPolicy(make_config(**options)).eval()


def raw_batch(batch_size: int, seed: int = 0) -> dict[str, Any]:
    generator = torch.Generator().manual_seed(seed)
    uniform = torch.rand(batch_size, 3, 4, generator=generator) * 2 - 1
    return {
        WORKSPACE: torch.rand(batch_size, 3, 64, 64, generator=generator),
        WRIST: torch.rand(batch_size, 3, 64, 64, generator=generator),
        "observation.state": torch.rand(batch_size, 4, generator=generator) * 2 - 1,
        "action": uniform,
        "action_is_pad": torch.zeros(batch_size, 3, dtype=torch.bool),
        "task": [TASK.format(i) + " really" * (i % 3) for i in range(batch_size)],
    }


def make_batch(policy: Vla0SmolPolicy, batch_size: int, seed: int = 0) -> dict[str, Any]:
    preprocessor, _ = make_vla0_smol_pre_post_processors(policy.config, STATS)
    return preprocessor(raw_batch(batch_size, seed))


def numbers_of(policy: Vla0SmolPolicy, batch: dict[str, Any]) -> NumberTokens:
    """The actions of a batch as the policy writes them."""
    return policy._numbers(*policy._targets(batch))


def sequence(policy: Vla0SmolPolicy, batch: dict[str, Any]) -> list[list[int]]:
    """Return each row's ids of question and answer, without padding."""
    prompt, answer = policy.prompt(batch), policy._answer(numbers_of(policy, batch)).rows
    pairs = zip(prompt.ids, prompt.mask, answer.ids, answer.mask, strict=True)
    return [[*ids[keep].tolist(), *said[kept].tolist()] for ids, keep, said, kept in pairs]
