import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from vla0_smol_cases import WORKSPACE, WRIST, make_batch, make_policy, numbers_of, raw_batch

from lerobot_bomb.actions.text import IGNORED
from lerobot_bomb.vlm.images import resize
from lerobot_bomb.vlm.prompt import normalize_task
from lerobot_bomb.vlm.tokenizer import load_tokenizer
from lerobot_policy_bomb.vla0_smol.modeling_vla0_smol import Vla0SmolPolicy

VLA0_JITTER = [0.2, 0.2, 0.2, 0.05]

# Sequence


def full_text(policy: Vla0SmolPolicy, task: str, state: list[int] | None, numbers: list[int]) -> str:
    """The string that the spec of the policy writes out, for two cameras."""
    system = policy.config.system_prompt
    system = "" if system is None else f"System: {system}<end_of_utterance>\n"
    image = "<image>" * policy.backbone.tokens_per_image
    image = f"<fake_token_around_image><global-img>{image}<fake_token_around_image>"
    state_text = "" if state is None else f"State: {' '.join(map(str, state))}, "
    return (
        f"<|im_start|>{system}User:{image}{image}Task: {normalize_task(task)}, {state_text}Actions: "
        f"<end_of_utterance>\n"
        f"Assistant: {' '.join(map(str, numbers))}<end_of_utterance>"
    )


def sequence(policy: Vla0SmolPolicy, batch: dict[str, Any]) -> list[list[int]]:
    """Token ids of every row, prompt and answer."""
    prompt = policy.prompt(batch)
    answer = policy._answer(numbers_of(policy, batch)).rows
    pairs = zip(prompt.ids, prompt.mask, answer.ids, answer.mask, strict=True)
    return [[*ids[keep].tolist(), *said[kept].tolist()] for ids, keep, said, kept in pairs]


@pytest.mark.parametrize("use_state", [True, False])
@pytest.mark.parametrize("system_prompt", [None, "Write numbers, 0 to 511.\nBe precise."])
def test_sequence_is_the_whole_string_tokenized(use_state: bool, system_prompt: str | None) -> None:
    policy = make_policy(use_state=use_state, system_prompt=system_prompt)
    batch = make_batch(policy, 3)
    raw = raw_batch(3)
    tokenizer = load_tokenizer("nano")
    for row, ids in enumerate(sequence(policy, batch)):
        state = policy.state_bins.encode(raw["observation.state"][row]).tolist() if use_state else None
        numbers = policy.action_bins.encode(raw["action"][row]).flatten().tolist()
        assert ids == tokenizer.encode(full_text(policy, raw["task"][row], state, numbers)).ids


@pytest.fixture(scope="module")
def real_tokens_policy(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Vla0SmolPolicy:
    """The real tokenizer and image geometry on a shrunk model with random weights."""
    from lerobot_bomb.vlm.backbone import build_backbone

    source = shared_data / "SmolVLM2-500M-Video-Instruct"
    config = json.loads((source / "config.json").read_text())
    config["text_config"] |= {
        "num_hidden_layers": 1,
        "hidden_size": 60,
        "intermediate_size": 64,
        "head_dim": 4,
    }
    config["vision_config"] |= {"num_hidden_layers": 1, "hidden_size": 24, "intermediate_size": 32}
    folder = tmp_path_factory.mktemp("smolvlm2")
    build_backbone(config).vlm.save_pretrained(folder)
    (folder / "tokenizer.json").write_bytes((source / "tokenizer.json").read_bytes())
    return make_policy(vlm_model_name=str(folder))


@pytest.mark.parametrize(
    "system_prompt", [None, pytest.param("Write numbers, 0 to 511.", marks=pytest.mark.long)]
)
def test_sequence_equals_the_real_processors(
    real_tokens_policy: Vla0SmolPolicy, shared_data: Path, system_prompt: str | None
) -> None:
    """Chat template, image expansion and tokenization by transformers, without tiling."""
    pytest.importorskip("num2words", reason="SmolVLM's processor cannot be built without num2words")
    from transformers import AutoProcessor

    policy = real_tokens_policy
    if system_prompt is not None:
        name = policy.config.vlm_model_name
        policy = make_policy(vlm_model_name=name, system_prompt=system_prompt)
    processor = AutoProcessor.from_pretrained(str(shared_data / "SmolVLM2-500M-Video-Instruct"))
    batch, raw = make_batch(policy, 3), raw_batch(3)
    for row, ids in enumerate(sequence(policy, batch)):
        state = " ".join(map(str, policy.state_bins.encode(raw["observation.state"][row]).tolist()))
        numbers = " ".join(map(str, policy.action_bins.encode(raw["action"][row]).flatten().tolist()))
        request = f"Task: {normalize_task(raw['task'][row])}, State: {state}, Actions: "
        messages = [
            {"role": "user", "content": [{"type": "image"}] * 2 + [{"type": "text", "text": request}]},
            {"role": "assistant", "content": [{"type": "text", "text": numbers}]},
        ]
        if system_prompt is not None:
            messages.insert(0, {"role": "system", "content": [{"type": "text", "text": system_prompt}]})
        text = processor.apply_chat_template(messages)
        images = [np.zeros((512, 512, 3), dtype=np.uint8)] * 2
        expected = processor(text=text, images=images, do_image_splitting=False)["input_ids"][0]
        newline = processor.tokenizer.encode("\n")
        assert ids + newline == list(expected)
    assert sequence(policy, batch)[0].count(49190) == 2 * 64


def test_the_real_tokenizer_trains_and_decodes(real_tokens_policy: Vla0SmolPolicy) -> None:
    batch = make_batch(real_tokens_policy, 2)
    loss, _ = real_tokens_policy(batch)
    assert 9 < loss.item() < 13  # ln 49280 = 10.8
    assert real_tokens_policy.predict_action_chunk(batch).shape == (2, 3, 4)


# Loss


def naive_loss(policy: Vla0SmolPolicy, batch: dict[str, Any], row: int) -> Tensor:
    """Row by row through the stock model on the full string; loss on all after ``Assistant:``."""
    raw = raw_batch(len(batch["action"]))
    state = policy.state_bins.encode(raw["observation.state"][row]).tolist()
    numbers = policy.action_bins.encode(batch["action"][row]).flatten().tolist()
    ids = load_tokenizer("nano").encode(full_text(policy, raw["task"][row], state, numbers)).ids
    length = len("".join(f" {number}" for number in numbers)) + 1
    size = policy.backbone.image_size
    crops = [resize(raw[key][row, :, 4:60, 4:60][None], size) for key in (WORKSPACE, WRIST)]
    logits = policy.backbone.vlm(
        input_ids=torch.tensor([ids]), pixel_values=(torch.stack(crops, dim=1) - 0.5) / 0.5
    ).logits[0]
    return torch.nn.functional.cross_entropy(
        logits[-length - 1 : -1], torch.tensor(ids[-length:]), reduction="none"
    )


@torch.no_grad()
def test_loss_is_that_of_the_stock_model_on_the_whole_string() -> None:
    policy = make_policy()
    batch = make_batch(policy, 3)
    losses = [naive_loss(policy, batch, row) for row in range(3)]
    torch.testing.assert_close(policy(batch)[0], torch.cat(losses).mean())
    per_row = policy(batch, reduction="none")[0]
    torch.testing.assert_close(per_row, torch.stack([loss.mean() for loss in losses]))


@torch.no_grad()
def test_padded_numbers_are_not_trained_on_but_the_end_is() -> None:
    policy = make_policy()
    batch = make_batch(policy, 2)
    batch["action_is_pad"] = torch.tensor([[False, True, True], [False, False, False]])
    naive = naive_loss(policy, batch, 0)
    first_step = policy.action_bins.encode(batch["action"][0, 0]).tolist()
    num_kept = len("".join(f" {number}" for number in first_step))
    expected = torch.cat([naive[:num_kept], naive[-1:]]).mean()
    torch.testing.assert_close(policy(batch, reduction="none")[0][0], expected)
    policy.config.loss_on_padded_actions = True
    torch.testing.assert_close(policy(batch, reduction="none")[0][0], naive.mean())


@torch.no_grad()
def test_values_of_padded_actions_reach_the_loss_through_the_end_only() -> None:
    policy = make_policy(chunk_size=3)
    batch = make_batch(policy, 1)
    batch["action_is_pad"] = torch.tensor([[False, True, True]])

    def labels(actions: Tensor) -> list[int]:
        answer_labels = policy._answer(numbers_of(policy, {**batch, "action": actions})).labels
        return answer_labels[answer_labels != IGNORED].tolist()

    other = batch["action"].clone()
    other[:, 1:] = -other[:, 1:]
    assert labels(other) == labels(batch["action"])
    other[:, 0] = -other[:, 0]
    assert labels(other) != labels(batch["action"])


def test_a_row_with_everything_hidden_gives_loss_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    policy = make_policy(mask_level="char")
    batch = make_batch(policy, 2)
    numbers = numbers_of(policy, batch)
    numbers = numbers.hide_characters(torch.ones_like(numbers.mask), policy.tokens.hidden)
    answer = policy._answer(numbers)
    assert (answer.labels != IGNORED).sum(dim=1).tolist() == [1, 1]  # the end
    monkeypatch.setattr(
        policy, "_answer", lambda _: replace(answer, labels=torch.full_like(answer.labels, IGNORED))
    )
    for reduction in ("mean", "none"):
        loss, _ = policy(batch, reduction=reduction)
        loss.sum().backward()
        assert torch.equal(loss, torch.zeros_like(loss))
    gradients = [parameter.grad for parameter in policy.parameters() if parameter.grad is not None]
    assert gradients and all(bool((gradient == 0).all()) for gradient in gradients)


# Hiding


@pytest.mark.parametrize("level", ["value", "step", "char"])
def test_numbers_are_hidden_in_training_only(level: str) -> None:
    policy = make_policy(mask_level=level, mask_max_fraction=1.0, mask_skip_prob=0.0)
    batch = make_batch(policy, 8)
    policy.train()
    hidden = torch.stack([(numbers_of(policy, batch).ids == policy.tokens.hidden).any() for _ in range(5)])
    assert hidden.all()
    policy.eval()
    assert not (numbers_of(policy, batch).ids == policy.tokens.hidden).any()


def test_a_hidden_step_hides_all_its_dimensions() -> None:
    policy = make_policy(mask_level="step", mask_max_fraction=1.0, mask_skip_prob=0.0).train()
    hidden = numbers_of(policy, make_batch(policy, 32)).ids[..., -1] == policy.tokens.hidden
    per_step = hidden.view(32, 3, 4).sum(dim=2)
    assert set(per_step.flatten().tolist()) == {0, 4}


def test_training_draws_do_not_touch_the_global_random_state() -> None:
    policy = make_policy(mask_max_fraction=0.5, color_jitter=VLA0_JITTER).train()
    batch = make_batch(policy, 4)
    torch.manual_seed(5)
    before = torch.get_rng_state()
    policy(batch)
    assert torch.equal(torch.get_rng_state(), before)


# Images


def test_the_crop_is_random_in_training_and_the_centre_in_evaluation() -> None:
    policy = make_policy(crop_fraction=0.5)
    batch = make_batch(policy, 2)
    ids = policy.prompt(batch).ids
    assert torch.equal(
        policy.embed(ids, policy.encode_images(batch)), policy.embed(ids, policy.encode_images(batch))
    )
    border = {**batch, WORKSPACE: batch[WORKSPACE].clone()}
    border[WORKSPACE][..., :16] = 0
    assert torch.equal(
        policy.embed(ids, policy.encode_images(border)), policy.embed(ids, policy.encode_images(batch))
    )
    policy.train()
    assert not torch.equal(
        policy.embed(ids, policy.encode_images(batch)), policy.embed(ids, policy.encode_images(batch))
    )


def test_colours_are_jittered_in_training_only() -> None:
    plain, jittered = (make_policy(crop_fraction=1.0, color_jitter=reach) for reach in (None, VLA0_JITTER))
    batch = make_batch(plain, 2)
    ids = plain.prompt(batch).ids
    assert torch.equal(
        jittered.embed(ids, jittered.encode_images(batch)), plain.embed(ids, plain.encode_images(batch))
    )
    plain.train()
    jittered.train()
    assert torch.equal(
        plain.embed(ids, plain.encode_images(batch)), plain.embed(ids, plain.encode_images(batch))
    )
    seen = [jittered.embed(ids, jittered.encode_images(batch)) for _ in range(2)]
    assert not torch.equal(*seen)
    # nothing but the images' tokens
    same = (seen[0] == seen[1]).all(dim=2).all(dim=0)
    assert set((~same).nonzero()[:, 0].tolist()) == set(plain.layout.image_columns(ids.device).tolist())


def test_a_resumed_training_jitters_as_the_uninterrupted_one() -> None:
    def losses(trained_batches: int, num_batches: int) -> list[float]:
        policy = make_policy(mask_max_fraction=0.0, crop_fraction=1.0, color_jitter=VLA0_JITTER).train()
        policy.config.trained_batches = trained_batches
        batch = make_batch(policy, 2)
        return [policy(batch)[0].item() for _ in range(num_batches)]

    whole = losses(0, 4)
    assert len(set(whole)) == 4
    assert losses(2, 2) == whole[2:]


def test_every_camera_counts_whatever_the_order_of_the_features() -> None:
    policy, other = make_policy(), make_policy(cameras=(WRIST, WORKSPACE))
    other.load_state_dict(policy.state_dict())
    batch = make_batch(policy, 2)
    assert policy(batch)[0] == other(batch)[0]
    for key in (WORKSPACE, WRIST):
        assert policy({**batch, key: 1 - batch[key]})[0] != policy(batch)[0]


def test_a_grey_image_changes_nothing_for_the_other_rows() -> None:
    policy = make_policy()
    batch = make_batch(policy, 3)
    before = policy(batch, reduction="none")[0]
    batch[WORKSPACE][1] = 0.5
    after = policy(batch, reduction="none")[0]
    torch.testing.assert_close(before[[0, 2]], after[[0, 2]])
    assert before[1] != after[1]


def test_a_missing_camera_is_an_error() -> None:
    policy = make_policy()
    batch = make_batch(policy, 1)
    del batch[WRIST]
    with pytest.raises(KeyError, match=r"vla0_smol needs 'observation.images.wrist'; the batch has"):
        policy.select_action(batch)


@pytest.mark.parametrize(
    "image", [torch.zeros(1, 3, 64, 64, dtype=torch.uint8), torch.zeros(1, 64, 64, 3), torch.zeros(3, 64, 64)]
)
def test_images_of_another_kind_are_an_error(image: Tensor) -> None:
    policy = make_policy()
    batch = {**make_batch(policy, 1), WRIST: image}
    with pytest.raises(ValueError, match=r"expected floats in \[0, 1\] of shape \(batch, 3, height, width\)"):
        policy.predict_action_chunk(batch)


def test_a_frozen_vision_encoder_gets_no_gradient() -> None:
    policy = make_policy(freeze_vision_encoder=True, gradient_checkpointing=True).train()
    policy(make_batch(policy, 2))[0].backward()
    model = policy.backbone.vlm.model
    assert all(parameter.grad is None for parameter in model.vision_model.parameters())
    assert all(parameter.grad is not None for parameter in model.connector.parameters())
    frozen = set(model.vision_model.parameters())
    assert not frozen & set(policy.get_optim_params())


def test_gradient_checkpointing_changes_no_gradient() -> None:
    gradients = []
    for checkpointing in (False, True):
        policy = make_policy(gradient_checkpointing=checkpointing, mask_max_fraction=0.0, crop_fraction=1.0)
        policy.train()(make_batch(policy, 2))[0].backward()
        gradients.append(policy.backbone.vlm.model.connector.modality_projection.proj.weight.grad)
    torch.testing.assert_close(gradients[0], gradients[1])


def test_an_action_chunk_of_another_length_is_refused() -> None:
    policy = make_policy()
    batch = make_batch(policy, 2)
    with pytest.raises(ValueError, match=r"shape \(2, 2, 4\); expected \(batch, 3, 4\)"):
        policy({**batch, "action": batch["action"][:, :2]})
