"""Flags of `fdvla`: what it refuses, what it does without, what follows from flags that are not given."""

import math
from typing import Any

import pytest
import torch
from fdvla_cases import (
    DENOISE_ONLY,
    FLOW_ONLY,
    SIZE,
    WORKSPACE,
    WRIST,
    make_batch,
    make_config,
    make_policy,
)

from lerobot_bomb.flag_errors import FlagError


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"chunk_size": 0}, "--policy.chunk_size=0 must be at least 1"),
        ({"n_action_steps": 5}, "--policy.n_action_steps=5 must lie in 1..4"),
        ({"use_flow_head": False, "use_denoise_head": False}, "--policy.use_flow_head .* at least one head"),
        ({**FLOW_ONLY, "sampler": "residual"}, "--policy.sampler=residual .* but use_denoise_head is off"),
        ({**FLOW_ONLY, "sampler": "ddim"}, "--policy.sampler=ddim .* but use_denoise_head is off"),
        ({**DENOISE_ONLY, "sampler": "flow"}, "--policy.sampler=flow .* but use_flow_head is off"),
        ({**FLOW_ONLY, "consistency_loss_weight": 0.1}, "--policy.consistency_loss_weight=0.1 compares both"),
        ({"consistency_loss_weight": -1.0}, "--policy.consistency_loss_weight=-1.0 must not be negative"),
        ({"consistency_loss_weight": math.nan}, "--policy.consistency_loss_weight=nan must be finite"),
        ({"consistency_loss_weight": math.inf}, "--policy.consistency_loss_weight=inf must be finite"),
        ({"flow_loss_weight": math.nan}, "--policy.flow_loss_weight=nan must be finite"),
        ({"denoise_loss_weight": math.inf}, "--policy.denoise_loss_weight=inf must be finite"),
        ({"optimizer_lr": math.nan}, "--policy.optimizer_lr=nan must be finite"),
        ({"optimizer_lr": math.inf}, "--policy.optimizer_lr=inf must be finite"),
        (
            {"consistency": "energy_vjp", "gradient_checkpointing": True},
            "consistency=energy_vjp takes",
        ),
        ({"flow_loss_weight": -1.0}, "--policy.flow_loss_weight=-1.0 must not be negative"),
        ({"refine_alpha": 1.5}, r"--policy.refine_alpha=1.5 must lie in \[0, 1\]"),
        ({"refine_alpha": -0.1}, "--policy.refine_alpha=-0.1"),
        ({"num_inference_steps": 0}, "--policy.num_inference_steps=0 must be at least 1"),
        ({"sampler": "sde", "solver": "heun"}, "--policy.solver=heun is for sampler residual, flow, paper"),
        ({"sampler": "ddpm"}, "--policy.sampler='ddpm' is unknown"),
        ({"denoise_tau_min": 0.0}, "--policy.denoise_tau_min=0.0"),
        ({"clip_sample_range": 0.0}, "--policy.clip_sample_range=0.0 must be positive"),
        ({"consistency": "trace"}, "--policy.consistency='trace' is unknown"),
        ({"consistency_detach": "both"}, "--policy.consistency_detach='both' is unknown"),
        ({"time_sampling": "cosine"}, "--policy.time_sampling='cosine' is unknown"),
        ({"reasoning_pool": "mean"}, "--policy.reasoning_pool='mean' is unknown"),
        ({"segment_attention": "full"}, "--policy.segment_attention='full' is unknown"),
        ({"train_vlm": "lora"}, "--policy.train_vlm='lora' is unknown"),
        ({"train_vlm": "frozen", "freeze_vision_encoder": False}, "needs --policy.train_vlm=full"),
        ({"image_size": 100}, "--policy.image_size=100 must be a multiple of 28 pixels"),
        (
            {"flow_loss_weight": 0.0, "consistency_detach": "flow"},
            "--policy.flow_loss_weight=0.0 leaves .*, or use_flow_head=false",
        ),
        ({"denoise_loss_weight": 0.0, "consistency": "none"}, "--policy.denoise_loss_weight=0.0 leaves"),
        ({**FLOW_ONLY, "flow_loss_weight": 0.0}, "--policy.flow_loss_weight=0.0 leaves"),
        ({"flow_loss_weight": 0.0, "denoise_loss_weight": 0.0}, "--policy.flow_loss_weight=0.0 leaves"),
        ({"head_dim": 0}, "--policy.head_dim=0 must be at least 1"),
        ({"crop_fraction": 0.0}, r"--policy.crop_fraction=0.0 must lie in \(0, 1\]"),
        ({"use_amp": True}, "--policy.dtype=bfloat16 instead"),
        ({"n_obs_steps": 2}, "--policy.n_obs_steps=2"),
        ({"vlm_config": {}}, "--policy.vlm_config={}, --policy.prompt_tokens=None: they come together"),
        ({"image_size": 28 * 10**6}, "--policy.image_size=28000000 makes 1000000000000 tokens of an image"),
        ({"chunk_size": 10**9}, "--policy.chunk_size=1000000000 must be at most 128000"),
    ],
)
def test_wrong_flags_are_told(options: dict[str, Any], message: str) -> None:
    with pytest.raises(FlagError, match=message):
        make_config(**options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"chunk_size": 4096}, "and the model has 4096 positions; give a smaller --policy.chunk_size"),
        ({"has_state": False}, "--policy.use_state=true needs the feature 'observation.state'"),
        ({"cameras": ()}, "fdvla needs at least one camera"),
    ],
)
def test_what_cannot_be_built_is_told(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_policy(**options)


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_actions_that_are_not_finite_are_told(value: float) -> None:
    policy = make_policy()
    batch = make_batch(policy, 3)
    batch["action"][1, 2, 0] = value
    with pytest.raises(ValueError, match=r"'action' is not finite in row 1 of the batch"):
        policy(batch)


def test_a_batch_that_lacks_something_is_told() -> None:
    policy = make_policy()
    batch = make_batch(policy, 2)
    for key in (WORKSPACE, "observation.state", "observation.language.tokens"):
        with pytest.raises(KeyError, match=f"fdvla needs '{key}'"):
            policy.predict_action_chunk({k: v for k, v in batch.items() if k != key})
    with pytest.raises(ValueError, match=r"expected \(batch, 4, 4\)"):
        policy({**batch, "action": batch["action"][:, :2]})
    with pytest.raises(ValueError, match=r"expected floats in \[0, 1\]"):
        policy({**batch, WRIST: torch.zeros(2, SIZE, SIZE, 3)})


def test_defaults_follow_the_heads() -> None:
    both, flow, denoise = (make_config(**options) for options in ({}, FLOW_ONLY, DENOISE_ONLY))
    assert [config.used_sampler for config in (both, flow, denoise)] == ["residual", "flow", "ddim"]
    assert [config.used_consistency_weight for config in (both, flow, denoise)] == [0.1, 0, 0]


@pytest.mark.parametrize("head", ["flow", "denoise"])
def test_a_head_learns_from_the_other_by_agreeing(head: str) -> None:
    options: dict[str, Any] = {f"{head}_loss_weight": 0.0}
    policy = make_policy(**options)
    policy(make_batch(policy, 2))[0].backward()
    gradients = [parameter.grad for parameter in getattr(policy, f"{head}_head").out.parameters()]
    assert all(gradient is not None and gradient.any() for gradient in gradients)


def test_every_part_is_counted() -> None:
    counts = make_policy().parameter_counts
    assert list(counts) == [
        *("backbone", "segment", "state_embedding", "flow_head", "denoise_head", "trained"),
    ]
    plain = make_policy(dualmod_flow=False, dualmod_denoise=False).parameter_counts
    film = 2 * 128 + (128 * 16 + 16) + (16 * 64 + 64)
    assert counts["flow_head"] - plain["flow_head"] == counts["denoise_head"] - plain["denoise_head"] == film


@pytest.mark.parametrize("tasks", [("", ""), ("", "go")])
def test_an_environment_may_name_no_task(tasks: tuple[str, ...]) -> None:
    """Check the empty text, which PushT gives."""
    policy = make_policy()
    batch = make_batch(policy, 2, tasks=tasks)
    assert policy(batch)[0].isfinite()
    assert policy.predict_action_chunk(batch).isfinite().all()
