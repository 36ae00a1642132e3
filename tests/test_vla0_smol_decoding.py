import copy
from typing import Any
from unittest.mock import patch

import pytest
import torch
from torch import Tensor
from vla0_smol_cases import WORKSPACE, make_batch, make_policy, numbers_of

from lerobot_bomb.actions.text import IGNORED
from lerobot_bomb.decoding.decoder import Decoded, decode_numbers, likeliest
from lerobot_bomb.flow.noise import SamplingNoise, gumbel
from lerobot_policy_bomb.vla0_smol.modeling_vla0_smol import Vla0SmolPolicy


def learn(policy: Vla0SmolPolicy, batch: dict[str, Any]) -> None:
    """Train until the batch is known by heart."""
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=2e-3, weight_decay=0.0)
    policy.train()
    for _ in range(400):
        loss, metrics = policy(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if loss.item() < 0.02 and metrics["token_accuracy"] == 1.0:
            break


@pytest.fixture(scope="module")
def overfit() -> tuple[Vla0SmolPolicy, dict[str, Any]]:
    """A policy that has learned four samples by heart."""
    policy = make_policy(crop_fraction=1.0, mask_max_fraction=0.0)
    batch = make_batch(policy, 4)
    learn(policy, batch)
    return policy.eval(), batch


def rows(batch: dict[str, Any], keep: slice) -> dict[str, Any]:
    return {key: value[keep] if isinstance(value, Tensor | list) else value for key, value in batch.items()}


# Decoding


def test_what_was_learned_by_heart_is_decoded(overfit: tuple[Vla0SmolPolicy, dict[str, Any]]) -> None:
    policy, batch = overfit
    chunk = policy.predict_action_chunk(batch)
    trained = policy.action_bins.decode(policy.action_bins.encode(batch["action"]))
    assert torch.equal(chunk, trained)


@torch.no_grad()
def test_decoding_follows_the_teacher_forced_argmax(overfit: tuple[Vla0SmolPolicy, dict[str, Any]]) -> None:
    policy, _ = overfit
    batch = make_batch(policy, 3, seed=9)  # unseen
    batch["action"] = policy.predict_action_chunk(batch)
    answer = policy._answer(numbers_of(policy, batch))
    prompt, features = policy.prompt(batch), policy.encode_images(batch)
    logits = policy._answer_logits(features, prompt, answer.rows)[..., policy.symbol_ids]
    for row_logits, row_labels in zip(logits, answer.labels, strict=True):
        place = policy.grammar.start(1)
        # every answer begins with a space
        for step_logits, label in zip(row_logits[1:], row_labels[row_labels != IGNORED][1:], strict=False):
            symbol, _ = likeliest(step_logits[None] + policy.grammar.logit_bias(place))
            assert policy.symbol_ids[symbol] == label
            place = policy.grammar.advance(place, symbol)
        assert place.prefix == policy.grammar.DONE


LINE: dict[str, Any] = {
    "mask_max_fraction": 0.0,
    "crop_fraction": 1.0,
    "n_action_bins": 99,
    "bin_mode": "levels",
    "chunk_size": 6,
}


def test_a_draft_changes_no_action_and_saves_passes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Weights that have learned chunks along a line."""
    policy = make_policy(**LINE)
    batch = make_batch(policy, 2)
    steps = torch.arange(6.0)[:, None]
    batch["action"] = torch.stack([steps * 0.1 - 0.3 * torch.ones(4), 0.5 - steps * torch.full((4,), 0.08)])
    batch["action_is_pad"] = torch.zeros(2, 6, dtype=torch.bool)
    learn(policy, batch)
    undrafted = make_policy(**{**LINE, "draft": "none"})
    undrafted.load_state_dict(policy.state_dict())
    seen: list[Decoded] = []

    def decode(*args: Any, **options: Any) -> Decoded:
        seen.append(decode_numbers(*args, **options))
        return seen[-1]

    monkeypatch.setattr("lerobot_bomb.decoding.writer.decode_numbers", decode)
    chunks = [one.predict_action_chunk(batch) for one in (policy, undrafted)]
    assert torch.equal(*chunks)
    drafted, plain = (decoded.num_passes for decoded in seen)
    assert drafted < 0.6 * plain
    assert (policy.last_passes, undrafted.last_passes) == (drafted, plain)
    numbers = seen[0].numbers.flatten().tolist()
    assert policy.last_tokens == sum(1 + len(str(number)) for number in numbers) / 2  # rows


def test_a_rows_actions_do_not_depend_on_the_batch(overfit: tuple[Vla0SmolPolicy, dict[str, Any]]) -> None:
    policy, _ = overfit
    batch = make_batch(policy, 5, seed=3)
    together = policy.predict_action_chunk(batch)
    assert len({len(text) for text in batch["task"]}) > 1
    for row in range(5):
        assert torch.equal(policy.predict_action_chunk(rows(batch, slice(row, row + 1)))[0], together[row])


@pytest.mark.parametrize(
    "options",
    [
        {"n_action_bins": 999, "bin_mode": "levels", "number_width": 3},
        {"n_action_bins": 2, "n_state_bins": 2, "use_state": False},
    ],
)
def test_an_untrained_model_gives_actions_in_range(options: dict[str, Any]) -> None:
    policy = make_policy(**options)
    chunk = policy.predict_action_chunk(make_batch(policy, 2))
    assert chunk.shape == (2, 3, 4)
    assert chunk.abs().max() <= 1


def test_actions_are_queued_and_forgotten_on_reset(overfit: tuple[Vla0SmolPolicy, dict[str, Any]]) -> None:
    policy, first = overfit
    second = {**first, "observation.state": -first["observation.state"], WORKSPACE: 1 - first[WORKSPACE]}
    chunks = [policy.predict_action_chunk(batch) for batch in (first, second)]
    assert not torch.equal(chunks[0][:, :2], chunks[1][:, :2])
    policy.reset()
    assert torch.equal(policy.select_action(first), chunks[0][:, 0])
    assert torch.equal(policy.select_action(second), chunks[0][:, 1])  # still of the first prediction
    assert torch.equal(policy.select_action(second), chunks[1][:, 0])
    policy.reset()
    assert torch.equal(policy.select_action(first), chunks[0][:, 0])
    policy.reset()


def test_a_sample_depends_on_seed_and_episode_alone() -> None:
    policy = make_policy(temperature=1.0)
    batch = make_batch(policy, 3)
    together = [policy.select_action(batch) for _ in range(4)]  # two chunks
    assert not torch.equal(together[0], together[2])
    alone = copy.deepcopy(policy)
    alone._sampling_noise = SamplingNoise(0, is_per_episode=True, draw=gumbel)
    for row in range(3):
        alone.reset()
        for action_BD in together:
            assert torch.equal(alone.select_action(rows(batch, slice(row, row + 1)))[0], action_BD[row])
    other = make_policy(temperature=1.0, noise_seed=1)
    assert not torch.equal(other.select_action(batch), together[0])


def test_a_low_temperature_is_greedy_and_a_draft_changes_no_sample() -> None:
    batch = make_batch(make_policy(), 2)
    greedy, cold = (make_policy(temperature=t).predict_action_chunk(batch) for t in (0.0, 1e-6))
    assert torch.equal(greedy, cold)
    drafted, plain = (
        make_policy(temperature=0.5, draft=draft).predict_action_chunk(batch) for draft in ("linear", "none")
    )
    assert torch.equal(drafted, plain) and not torch.equal(plain, greedy)


def test_what_lerobots_callers_pass_is_taken_and_the_rest_refused_by_name() -> None:
    policy = make_policy()
    batch = make_batch(policy, 2)
    left_over = torch.zeros(2, 2, 4)
    chunk = policy.predict_action_chunk(batch, inference_delay=1, prev_chunk_left_over=left_over)
    assert torch.equal(chunk, policy.predict_action_chunk(batch))
    with pytest.raises(TypeError, match="'noise'"):
        policy.predict_action_chunk(batch, noise=left_over)  # pyright: ignore[reportCallIssue]
    with pytest.raises(TypeError, match="'temperature'"):
        policy.select_action(batch, temperature=1.0)  # pyright: ignore[reportCallIssue]


@pytest.mark.parametrize("options", [{}, {"temporal_ensemble_size": 2, "n_action_steps": 1}])
def test_another_size_of_batch_needs_a_reset(options: dict[str, Any]) -> None:
    policy = make_policy(**options)
    policy.select_action(make_batch(policy, 3))
    message = (
        r"a batch of 2 observations follows one of 3, whose episodes are under way; call policy.reset\(\)"
    )
    with pytest.raises(ValueError, match=message):
        policy.select_action(make_batch(policy, 2))
    policy.reset()
    assert len(policy.select_action(make_batch(policy, 2))) == 2


# Precision


def test_in_bfloat16_no_two_digits_are_equally_likely() -> None:
    """Check ties: in bfloat16's own head a digit in a dozen has one, and argmax takes the lower."""
    policy = make_policy(dtype="bfloat16", chunk_size=40)
    seen: list[Tensor] = []

    def record(logits: Tensor) -> tuple[Tensor, Tensor]:
        seen.append(logits.flatten(0, -2).topk(2, dim=-1).values)
        return likeliest(logits)

    with patch("lerobot_bomb.decoding.decoder.likeliest", record):
        policy.predict_action_chunk(make_batch(policy, 8))
    best_N2 = torch.cat(seen)
    open_N2 = best_N2[best_N2.isfinite().all(dim=1)]
    assert len(open_N2) > 1000
    assert (open_N2[:, 0] > open_N2[:, 1]).float().mean() > 0.999


def test_bfloat16_is_the_same_for_training_and_decoding() -> None:
    policy = make_policy(dtype="bfloat16")
    batch = make_batch(policy, 2)
    plain = copy.deepcopy(policy)
    plain.config.dtype = "float32"
    with torch.no_grad():
        with torch.autocast("cpu", dtype=torch.bfloat16):
            inside = policy(batch)[0]
        assert policy(batch)[0] == inside
        assert plain(batch)[0] != inside
    seen: list[torch.dtype] = []
    last_layer = policy.backbone.vlm.model.text_model.get_submodule("layers")[-1]  # pyright: ignore[reportIndexIssue]
    last_layer.mlp.down_proj.register_forward_hook(lambda *call: seen.append(call[2].dtype))
    policy.predict_action_chunk(batch)
    assert set(seen) == {torch.bfloat16}


def test_training_goes_on_after_evaluation_inside_one_autocast() -> None:
    policy = make_policy(dtype="bfloat16")
    batch = make_batch(policy, 2)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        with torch.inference_mode():
            policy.select_action(batch)
        loss, _ = policy.train()(batch)
        loss.backward()
    assert policy.backbone.vlm.lm_head.weight.grad is not None


def test_a_batch_on_another_device_is_refused() -> None:
    policy = make_policy()
    batch = make_batch(policy, 2)
    batch["observation.state"] = batch["observation.state"].to("meta")
    with pytest.raises(ValueError, match=r"batch\['observation.state'\] is on meta, the policy on cpu"):
        policy.predict_action_chunk(batch)


def test_an_answer_that_does_not_fit_the_model_is_refused() -> None:
    policy = make_policy(chunk_size=251, n_action_steps=251)
    with pytest.raises(
        ValueError,
        match=r"model has 4096 positions; shorten the instruction or give a smaller --policy.chunk_size",
    ):
        policy.predict_action_chunk(make_batch(policy, 1))


def test_an_answer_that_can_never_fit_the_model_is_refused_before_training() -> None:
    with pytest.raises(ValueError, match=r"prompt and answer take 4868 tokens, and the model has 4096"):
        make_policy(chunk_size=300, n_action_steps=300)
