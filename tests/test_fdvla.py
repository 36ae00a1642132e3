"""The policy `fdvla` on the nano backbone: what it trains and what it reads."""

from typing import Any

import pytest
import torch
from fdvla_cases import DENOISE_ONLY, FLOW_ONLY, WORKSPACE, WRIST, make_batch, make_policy, rows
from torch import Tensor
from torch.nn.functional import scaled_dot_product_attention

from lerobot_bomb.flow.path import PathPoint, path_point
from lerobot_policy_bomb.fdvla.modeling_fdvla import FdvlaPolicy
from lerobot_policy_bomb.fdvla.networks_fdvla import SideBySide

ENERGY: dict[str, Any] = {"consistency": "energy_vjp"}


def fixed_point(batch: dict[str, Any]) -> PathPoint:
    generator = torch.Generator().manual_seed(0)
    actions = batch["action"]
    noise = torch.randn(actions.shape, generator=generator)
    return path_point(actions, noise, torch.rand(len(actions), generator=generator))


def train_alike(
    policy: FdvlaPolicy, batch: dict[str, Any]
) -> tuple[Tensor, dict[str, float], dict[str, Tensor]]:
    """Loss, metrics and gradients of a step with the noise of seed 0."""
    policy.generator.manual_seed(0)
    policy.zero_grad()
    loss, metrics = policy(batch)
    loss.backward()
    gradients = {name: p.grad.clone() for name, p in policy.named_parameters() if p.grad is not None}
    return loss.detach(), metrics, gradients


def wake_dualmod(policy: FdvlaPolicy) -> FdvlaPolicy:
    """Wake the heads as some training would: pooled states do change the features."""
    torch.manual_seed(1)
    for head in (policy.flow_head, policy.denoise_head):
        if head is not None and head.film is not None:
            torch.nn.init.normal_(head.film.layers[-1].get_parameter("weight"), std=0.5)
    return policy


# Learning


@pytest.mark.parametrize(
    ("num_dims", "options"),
    [
        (4, {}),
        (2, {"has_state": False, "use_state": False, **FLOW_ONLY}),
        pytest.param(7, {"cameras": (WORKSPACE,), "dtype": "bfloat16"}, marks=pytest.mark.long),
        pytest.param(14, {"segment_attention": "causal", "reasoning_pool": "last"}, marks=pytest.mark.long),
        # a noise head alone says little of the actions where there is little but noise
        pytest.param(
            4,
            {"num_inference_steps": 10, "draws_per_chunk": 16, **DENOISE_ONLY},
            marks=pytest.mark.long,
        ),
    ],
)
def test_chunks_are_learned(num_dims: int, options: dict[str, Any]) -> None:
    policy = make_policy(num_dims=num_dims, **options)
    batch = make_batch(policy, 2)
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=2e-3, weight_decay=0.0)
    for step in range(300):
        loss, _ = policy(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % 25 == 24:
            policy.reset()
            if (policy.predict_action_chunk(batch) - batch["action"]).abs().mean() < 0.25:
                return
    pytest.fail(f"not learned in 300 steps; loss {float(loss)}")


def test_the_loss_is_that_of_both_heads() -> None:
    policy = make_policy()
    batch = make_batch(policy, 3)
    policy.generator.manual_seed(0)
    loss, metrics = policy(batch)
    assert set(metrics) == {"flow_loss", "denoise_loss", "consistency_loss", "consistency_residual_rms"}
    assert all(isinstance(value, float) for value in metrics.values())
    total = metrics["flow_loss"] + metrics["denoise_loss"] + 0.1 * metrics["consistency_loss"]
    assert loss.item() == pytest.approx(total, rel=1e-5)
    policy.generator.manual_seed(0)
    losses, _ = policy(batch, reduction="none")
    assert losses.shape == (3,)
    torch.testing.assert_close(losses.mean(), loss)
    with pytest.raises(ValueError, match="reduction"):
        policy(batch, reduction="sum")


@pytest.mark.parametrize(
    ("options", "names"),
    [
        (FLOW_ONLY, {"flow_loss"}),
        (DENOISE_ONLY, {"denoise_loss"}),
        ({"consistency": "none"}, {"flow_loss", "denoise_loss", "consistency_residual_rms"}),
    ],
)
def test_terms_are_those_of_the_heads_there_are(options: dict[str, Any], names: set[str]) -> None:
    policy = make_policy(**options)
    assert set(policy(make_batch(policy, 2))[1]) == names


@pytest.mark.parametrize("options", [{}, {"segment_attention": "causal"}, ENERGY])
def test_padded_steps_change_neither_loss_nor_gradient(options: dict[str, Any]) -> None:
    policy = wake_dualmod(make_policy(**options))
    batch = make_batch(policy, 2)
    batch["action_is_pad"] = torch.tensor([[False, False, True, True], [False] * 4])
    changed = {**batch, "action": batch["action"].clone()}
    changed["action"][0, 2:] = 100
    loss, metrics, gradients = train_alike(policy, batch)
    other, other_metrics, other_gradients = train_alike(policy, changed)
    assert torch.equal(loss, other) and metrics == other_metrics
    assert all(torch.equal(gradients[name], other_gradients[name]) for name in gradients)
    policy.config.loss_on_padded_actions = True
    assert not torch.isclose(policy(batch)[0], policy(changed)[0], rtol=0.1)


def test_a_batch_of_padding_has_no_loss() -> None:
    policy = make_policy()
    batch = make_batch(policy, 2)
    batch["action_is_pad"] = torch.ones(2, 4, dtype=torch.bool)
    loss, _, gradients = train_alike(policy, batch)
    assert loss == 0 and not any(gradient.any() for gradient in gradients.values())


def test_the_energys_gradient_passes_through_the_model() -> None:
    """It takes second derivatives, which fused attention lacks, also where evaluation keeps no gradients."""
    policy = make_policy(**ENERGY)
    batch = make_batch(policy, 2)
    _, metrics, gradients = train_alike(policy, batch)
    assert metrics["consistency_loss"] > 0
    linear = make_policy()
    assert metrics["consistency_loss"] != train_alike(linear, batch)[1]["consistency_loss"]
    other = train_alike(linear, batch)[2]
    assert not torch.allclose(gradients["segment.positions"], other["segment.positions"])
    with torch.no_grad():
        policy.generator.manual_seed(0)
        assert policy(batch)[1] == metrics


# What is trained


@pytest.mark.parametrize(
    ("options", "vision", "language"),
    [
        ({}, False, True),
        ({"freeze_vision_encoder": False}, True, True),
        ({"train_vlm": "frozen"}, False, False),
    ],
)
def test_gradients_reach_what_is_trained(options: dict[str, Any], vision: bool, language: bool) -> None:
    policy = wake_dualmod(make_policy(gradient_checkpointing=True, **options)).train()
    _, _, gradients = train_alike(policy, make_batch(policy, 2))
    trained = {name for name, parameter in policy.named_parameters() if parameter.requires_grad}
    assert gradients.keys() == trained
    assert sum(p.numel() for p in policy.get_optim_params()) == policy.parameter_counts["trained"]
    parts = {"visual": vision, "language_model": language}
    for name, _ in policy.backbone.named_parameters():
        part = next(part for part in parts if part in name)
        assert (f"backbone.{name}" in trained) == parts[part], name
    for name in trained:
        if "backbone" not in name:
            assert gradients[name].any(), name


def test_gradient_checkpointing_changes_no_gradient() -> None:
    batches = []
    for checkpointing in (False, True):
        policy = make_policy(gradient_checkpointing=checkpointing, freeze_vision_encoder=False).train()
        batches.append(train_alike(policy, make_batch(policy, 2)))
    (loss, _, gradients), (other, _, other_gradients) = batches
    assert torch.equal(loss, other) and gradients.keys() == other_gradients.keys()
    for name, gradient in gradients.items():
        torch.testing.assert_close(gradient, other_gradients[name], msg=name)


def test_a_head_of_words_that_is_no_embedding_is_frozen() -> None:
    policy = make_policy()
    config = {**(policy.config.vlm_config or {}), "tie_word_embeddings": False}
    untied = make_policy(vlm_config=config, prompt_tokens=policy.config.prompt_tokens)
    assert not untied.backbone.vlm.lm_head.weight.requires_grad
    assert untied.backbone.vlm.get_input_embeddings().weight.requires_grad


# What is read


@torch.no_grad()
def test_heads_say_the_same_in_training_and_in_sampling(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compare at the same noisy actions and time, whatever else is in the batch."""
    policy = wake_dualmod(make_policy(draws_per_chunk=1))
    batch = make_batch(policy, 3)
    point = fixed_point(batch)
    seen: list[tuple[Tensor, Tensor]] = []
    heads: Any = policy._heads

    def noted(*context: Any) -> Any:
        predict = heads(*context)

        def note(*args: Tensor) -> tuple[Tensor, Tensor]:
            seen.append(predict(*args))
            return seen[-1]

        return note

    monkeypatch.setattr(policy, "_heads", noted)
    monkeypatch.setattr(policy, "_draw_point", lambda _: point)
    policy(batch)
    for row in range(3):
        context = policy._read(rows(batch, [row]))
        alone = heads(context)(point.actions[row : row + 1], point.tau[row : row + 1])
        for trained, sampled in zip(seen[0], alone, strict=True):
            torch.testing.assert_close(sampled, trained[row : row + 1], rtol=0, atol=1e-5)


@torch.no_grad()
def test_the_prompt_never_reads_the_actions(monkeypatch: pytest.MonkeyPatch) -> None:
    policy = make_policy()
    batch = make_batch(policy, 2)
    states: list[Tensor] = []
    read_prefix = policy.backbone.read_prefix

    def note(*args: Any) -> Any:
        prefix = read_prefix(*args)
        states.extend([prefix.hidden, *prefix.layers[-1]])
        return prefix

    monkeypatch.setattr(policy.backbone, "read_prefix", note)
    policy(batch)
    policy({**batch, "action": batch["action"] + 1})
    policy.predict_action_chunk(batch)
    assert all(torch.equal(states[i], states[i % 3]) for i in range(9))


@torch.no_grad()
@pytest.mark.parametrize("attention", ["bidirectional", "causal"])
def test_which_actions_read_which(attention: str) -> None:
    policy = make_policy(segment_attention=attention)
    batch = make_batch(policy, 1)
    context, point = policy._read(batch), fixed_point(batch)
    changed = point.actions.clone()
    changed[:, 2] += 1
    velocities = [policy._heads(context)(actions, point.tau)[0] for actions in (point.actions, changed)]
    assert velocities[0] is not None and velocities[1] is not None
    differs = (velocities[0] != velocities[1]).any(dim=2)[0].tolist()
    assert differs == ([True] * 4 if attention == "bidirectional" else [False, False, True, True])


@torch.no_grad()
def test_dualmod_is_the_identity_before_training() -> None:
    policy = make_policy()
    plain = make_policy(dualmod_flow=False, dualmod_denoise=False)
    missing, unexpected = plain.load_state_dict(policy.state_dict(), strict=False)
    assert not missing and unexpected and all(".film." in name for name in unexpected)
    batch = make_batch(policy, 3)
    noise = torch.randn(3, 4, 4)
    assert torch.equal(policy.predict_action_chunk(batch, noise), plain.predict_action_chunk(batch, noise))


@torch.no_grad()
@pytest.mark.parametrize("pool", ["text", "all_prefix", "last"])
def test_what_is_pooled(pool: str) -> None:
    policy = make_policy(reasoning_pool=pool)
    batch = make_batch(policy, 3, tasks=("put the black stone on the center", "go", ""))
    prompt = policy.prompt(batch)
    span = policy.layout.spans(prompt.ids.shape[1])["instruction"]
    instruction_BL = torch.zeros_like(prompt.mask)
    instruction_BL[:, span] = prompt.mask[:, span]
    context = policy._read(batch)
    hidden = context.prefix.hidden
    for row in range(3):
        kept = prompt.mask[row]
        if pool == "text" and instruction_BL[row].any():
            kept = instruction_BL[row]
        expected = hidden[row, -1] if pool == "last" else hidden[row, kept].mean(dim=0)
        torch.testing.assert_close(context.pooled[row], expected)
    lengths = instruction_BL.sum(dim=1)
    assert lengths[0] > lengths[1] > lengths[2] == 0
    end = len(policy.tokens.end) + policy.config.use_state
    assert prompt.mask[:, -end:].all() and not instruction_BL[:, -end:].any()


@torch.no_grad()
def test_images_instruction_state_and_time_matter() -> None:
    policy = wake_dualmod(make_policy(crop_fraction=0.9))
    batch = make_batch(policy, 1)
    noise = torch.zeros(1, 4, 4)
    usual = policy.predict_action_chunk(batch, noise)
    other = make_batch(policy, 1, seed=1, tasks=("push the white stone",))
    keys = (WORKSPACE, WRIST, "observation.state", "observation.language.tokens")
    for key in keys:
        changed = {**batch, key: other[key]}
        if "tokens" in key:
            changed["observation.language.attention_mask"] = other["observation.language.attention_mask"]
        assert not torch.allclose(policy.predict_action_chunk(changed, noise), usual, atol=1e-4), key
    swapped = {**batch, WORKSPACE: batch[WRIST], WRIST: batch[WORKSPACE]}
    assert not torch.allclose(policy.predict_action_chunk(swapped, noise), usual, atol=1e-4)
    context, point = policy._read(batch), fixed_point(batch)
    early, late = (policy._heads(context)(point.actions, torch.tensor([tau]))[1] for tau in (0.1, 0.9))
    assert early is not None and late is not None and not torch.allclose(early, late, atol=1e-3)


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_attention_is_fused_and_in_float32_on_a_cpu(dtype: str) -> None:
    """Check that torch's fused attention in bfloat16 is avoided: it takes four to ten times as long."""
    query = torch.randn(1, 1, 2, 8, generator=torch.manual_seed(0), requires_grad=True)
    with make_policy(dtype=dtype).autocast():
        attended = scaled_dot_product_attention(query, query, query)
    assert torch.equal(attended, scaled_dot_product_attention(query, query, query))
    names, node = [], attended.grad_fn
    while node is not None:
        names.append(node.name())
        node = node.next_functions[0][0] if node.next_functions else None
    assert any("FlashAttention" in name for name in names)


def test_draws_side_by_side_read_their_own_tokens() -> None:
    reads = torch.tensor([[[1, 0], [1, 1]], [[1, 1], [1, 1]]], dtype=torch.bool)
    assert SideBySide(2).attention_mask(reads).int().tolist() == [
        [[1, 0, 0, 0], [1, 1, 0, 0], [0, 0, 1, 1], [0, 0, 1, 1]]
    ]
    assert torch.equal(SideBySide(1).attention_mask(reads), reads)
    embeds = torch.arange(8).reshape(2, 2, 2)
    assert SideBySide(2).joined(embeds).tolist() == [[[0, 1], [2, 3], [4, 5], [6, 7]]]


def test_draws_of_a_chunk_are_trained_as_if_each_were_read_alone() -> None:
    policy = wake_dualmod(make_policy(draws_per_chunk=3))
    batch = make_batch(policy, 2)
    context, kept = policy._read(batch), policy._loss_mask(batch).repeat_interleave(3, dim=0)
    actions, tau = torch.randn(6, 4, 4), torch.rand(6)
    together = policy._heads(context, kept)(actions, tau)
    for draw in range(3):
        alone = policy._heads(context, kept[draw::3])(actions[draw::3], tau[draw::3])
        for of_all, of_one in zip(together, alone, strict=True):
            assert of_all is not None and of_one is not None
            torch.testing.assert_close(of_all[draw::3], of_one, rtol=1e-4, atol=1e-5)
