"""Precision: what --policy.dtype and --policy.weights_dtype change in all policies, and what not."""

from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import get_policy_class
from policy_cases import CASES, save_checkpoint
from torch import Tensor

import lerobot_bomb.vlm.attention
from lerobot_bomb.decoding.qkv import RopePairs
from lerobot_bomb.flag_errors import FlagError
from lerobot_bomb.vlm.backbone import PRODUCTS

BFLOAT16 = {"dtype": "bfloat16", "weights_dtype": "bfloat16"}


def gradients(policy_type: str, **options: Any) -> dict[str, Tensor]:
    cases = CASES[policy_type]
    policy = cases.make_policy(crop_fraction=1.0, dtype="bfloat16", **options).train()
    policy.generator.manual_seed(0)
    policy(cases.make_batch(policy, 2))[0].backward()
    return {name: p.grad for name, p in policy.named_parameters() if p.grad is not None}


def test_checkpointing_in_bfloat16_changes_no_gradient(policy_type: str) -> None:
    kept, computed_again = (gradients(policy_type, gradient_checkpointing=value) for value in (False, True))
    assert kept.keys() == computed_again.keys()
    for name, gradient in kept.items():
        torch.testing.assert_close(computed_again[name], gradient, msg=name)


@pytest.mark.parametrize("is_fast", [False, True])
def test_bfloat16_that_the_processor_lacks_is_warned_of(
    is_fast: bool, policy_type: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(lerobot_bomb.vlm.attention, "is_bfloat16_fast", lambda: is_fast)
    caplog.set_level("WARNING", logger="lerobot_bomb")  # another test may have lowered it to INFO
    CASES[policy_type].make_policy(dtype="float32")
    assert not caplog.messages
    CASES[policy_type].make_policy(dtype="bfloat16")
    assert len(caplog.messages) == (not is_fast)


def load(folder: Path, **options: Any) -> Any:
    config = PreTrainedConfig.from_pretrained(folder)
    for name, value in options.items():
        setattr(config, name, value)
    return get_policy_class(config.type).from_pretrained(folder, config=config)


@torch.no_grad()
def test_weights_in_bfloat16_change_no_answer(policy_type: str, tmp_path: Path) -> None:
    save_checkpoint(policy_type, tmp_path)
    single, half = load(tmp_path, dtype="bfloat16"), load(tmp_path, **BFLOAT16)
    batch = CASES[policy_type].make_batch(single, 2)
    for policy in (single, half):
        policy.generator.manual_seed(0)
    assert torch.equal(single(batch)[0], half(batch)[0])
    chunks = [policy.predict_action_chunk(batch) for policy in (single, half)]
    torch.testing.assert_close(*chunks, rtol=0, atol=0.01 if policy_type == "fdvla" else 0)


@torch.no_grad()
def test_queries_of_weights_in_bfloat16_are_those_of_autocast(tmp_path: Path) -> None:
    """Check a scale, 32 ** -0.5, that is no power of two: a product with it would round weights again."""
    save_checkpoint("vla0_smol", tmp_path)
    policies = load(tmp_path, dtype="bfloat16"), load(tmp_path, **BFLOAT16)
    attentions = [policy.backbone.vlm.model.text_model.layers[0].self_attn for policy in policies]
    generator = torch.Generator().manual_seed(0)
    hidden, half_head = attentions[0].q_proj.in_features, attentions[0].head_dim // 2
    states = torch.randn(8, hidden, generator=generator)
    rope = torch.polar(torch.ones(8, 1, half_head), torch.rand(8, 1, half_head, generator=generator))
    with torch.autocast("cpu", torch.bfloat16):
        heads = [RopePairs(attention)(states.bfloat16(), rope) for attention in attentions]
    for of_single, of_half in zip(*heads, strict=True):
        assert torch.equal(of_single, of_half)


def test_of_the_backbone_only_products_are_in_bfloat16(policy_type: str, tmp_path: Path) -> None:
    save_checkpoint(policy_type, tmp_path)
    policy = load(tmp_path, **BFLOAT16)
    vlm = policy.backbone.vlm
    words = vlm.get_input_embeddings(), vlm.get_output_embeddings()
    products = {
        id(weight)
        for module in vlm.modules()
        if isinstance(module, PRODUCTS) and module not in words
        for weight in module.parameters()
    }
    for name, values in [*policy.named_parameters(), *policy.named_buffers()]:
        is_half = id(values) in products
        assert not values.is_floating_point() or (values.dtype == torch.bfloat16) == is_half, name
    in_float32 = load(tmp_path)
    for (name, expected), actual in zip(in_float32.named_buffers(), policy.buffers(), strict=True):
        assert torch.equal(expected, actual), name


def test_weights_in_bfloat16_are_not_trained(policy_type: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"--policy.weights_dtype=bfloat16 is for the evaluation"):
        CASES[policy_type].make_policy(**BFLOAT16)


def test_weights_in_bfloat16_need_computation_in_bfloat16(policy_type: str) -> None:
    with pytest.raises(FlagError, match=r"--policy.weights_dtype=bfloat16 needs --policy.dtype=bfloat16"):
        CASES[policy_type].make_config(weights_dtype="bfloat16", dtype="float32")
