"""Explanations of one moment: identities that hold whatever the policy is."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from explain_cases import NAMES, WORKSPACE, WRIST, ask, fresh, loaded, moment, query, scored_by, without_image
from torch import Tensor
from torch.nn.functional import pad

from lerobot_bomb.explain.activations import LAYER, PARTS, Unit, all_heads, all_layers, all_mlps, recording
from lerobot_bomb.explain.images import filling, occluded, patch_masks
from lerobot_bomb.explain.moment import explain
from lerobot_bomb.explain.patching import OTHER_INSTRUCTION
from lerobot_bomb.explain.question import Question
from lerobot_bomb.explain.restoration import Corruption, Restoration
from lerobot_bomb.explain.scored_policy import repeated
from lerobot_bomb.explain.spans import difference, span_of, spans_of_words, token_offsets

pytestmark = pytest.mark.usefixtures("loaded_policies")

RTOL = 1e-5  # of a score


def close(scores: Tensor | float, expected: Tensor | float, question: Question) -> bool:
    difference = torch.as_tensor(scores) - torch.as_tensor(expected)
    return bool((difference.abs() <= RTOL * max(1.0, abs(question.clean_score))).all())


def blank(question: Question, key: str) -> Tensor:
    """(1, 3, H, W) without anything in it."""
    (image,) = question.observation[key]
    return filling(image, "mean", 1.0)[None]


@pytest.mark.parametrize("name", NAMES)
def test_what_is_as_it_was_has_no_effect(name: str) -> None:
    question = ask(loaded(name))
    (image,) = question.observation[WORKSPACE]
    empty = torch.zeros(2, *image.shape[1:], dtype=torch.bool)
    effects = question.effects_of_masks(WORKSPACE, empty, filling(image, "mean", 1.0))
    assert close(effects, 0.0, question)
    num_tokens = len(token_offsets(loaded(name).prepare.steps, moment()[1]))
    assert close(question.effects_of_hidden(torch.zeros(1, num_tokens, dtype=torch.bool)), 0.0, question)
    assert close(question.effects_of_instructions([moment()[1]]), 0.0, question)


@pytest.mark.parametrize("name", NAMES)
def test_what_a_policy_needs_has_one(name: str) -> None:
    question = ask(loaded(name))
    changed = {key: blank(question, key) for key in (WORKSPACE, WRIST)}
    assert abs(float(question.effects_of_images(changed))) > 1e-2
    others = [instruction for instruction, _ in moment()[3].values()]
    assert float(question.effects_of_instructions(others).max()) > 1e-2


@pytest.mark.parametrize("name", NAMES)
def test_rows_beside_it_change_no_score(name: str) -> None:
    alone, together = ask(loaded(name), batch_size=1), ask(loaded(name))
    (image,) = alone.observation[WORKSPACE]
    masks, filled = patch_masks(4, *image.shape[1:]), filling(image, "mean", 1.0)
    one_by_one, all_at_once = (each.effects_of_masks(WORKSPACE, masks, filled) for each in (alone, together))
    assert close(one_by_one, all_at_once, together)
    spans = spans_of_words(moment()[1])
    offsets = token_offsets(loaded(name).prepare.steps, moment()[1])
    hidden = torch.stack([span.tokens(offsets) for span in spans])
    assert close(alone.effects_of_hidden(hidden), together.effects_of_hidden(hidden), together)


@pytest.mark.parametrize("name", NAMES)
def test_the_fast_way_gives_what_the_slow_one_does(name: str) -> None:
    question = ask(loaded(name))
    (image,) = question.observation[WORKSPACE]
    masks, filled = patch_masks(2, *image.shape[1:]), filling(image, "mean", 1.0)
    fast = question.effects_of_masks(WORKSPACE, masks, filled)
    for effect, changed in zip(fast, occluded(image, masks, filled), strict=True):
        slow = Question(
            question.policy, loaded(name).prepare, question.observation | {WORKSPACE: changed[None]}
        )
        score = question.policy.score(slow.rows, question.answer)
        assert close(effect, question.clean_score - score, question)
    offsets = token_offsets(loaded(name).prepare.steps, moment()[1])
    hidden = span_of("black", moment()[1]).tokens(offsets)[None]
    batch = question.policy.hide_in(loaded(name).prepare(question.observation), hidden[0])
    score = question.policy.score(question.policy.encode(batch), question.answer)
    assert close(question.effects_of_hidden(hidden), question.clean_score - score, question)


@pytest.mark.parametrize("name", NAMES)
def test_the_clean_answer_is_the_policys(name: str) -> None:
    policy, question = loaded(name), ask(loaded(name))
    policy.begin()
    again = question.policy.answer(policy.prepare(question.observation))
    assert torch.equal(again, question.answer)


@pytest.mark.parametrize(
    ("name", "flag"), [("fdvla", "noise_per_episode=true"), ("vla0_smol", "temperature=1")]
)
def test_an_episode_begins_with_its_own_noise(name: str, flag: str) -> None:
    policy = fresh(name, flags=[f"--{flag}"])
    (observation, instruction, *_), actions = moment(), []
    for number in (0, 0, 1):
        policy.begin(number)
        actions.append(policy.agent([observation], [instruction]).tolist())
    assert actions[0] == actions[1] != actions[2]


def corruptions(name: str) -> list[Corruption]:
    """Corrupt the question by an image, and by an instruction of as many tokens."""
    question = ask(loaded(name))
    other = moment()[3]["column"][0]
    return [
        Corruption(question, rows)
        for rows in (without_image(question), question.encode({"task": [other]}, 1))
    ]


def with_hidden_word(name: str) -> Corruption:
    """Corrupt the question by hiding the column."""
    question = ask(loaded(name))
    instruction, others = moment()[1], moment()[3]
    span = difference("column", instruction, others["column"][0])
    assert span is not None
    hidden = span.tokens(token_offsets(loaded(name).prepare.steps, instruction))[None]
    return Corruption(question, question.policy.hide(question.rows, hidden))


@pytest.mark.parametrize("name", NAMES)
def test_all_layers_put_back_are_the_clean_score_and_corrupt_ones_the_corrupt_score(name: str) -> None:
    layers = scored_by(loaded(name)).layers
    for corruption in corruptions(name):
        everything = [all_layers(len(layers))]
        restored = corruption.restore(everything)
        assert restored.is_defined
        assert float(restored.ratios) == pytest.approx(1, abs=1e-3)
        units = [[unit] for unit in (*all_layers(len(layers)), *all_heads(layers), *all_mlps(len(layers)))]
        assert corruption.restore_corrupt([*everything, *units]).ratios.tolist() == pytest.approx(
            [0] * (1 + len(units)), abs=1e-3
        )


@pytest.mark.parametrize("name", NAMES)
def test_what_the_layers_make_of_the_words_that_are_left_is_put_back_token_by_token(name: str) -> None:
    corruption = with_hidden_word(name)
    layers = scored_by(loaded(name)).layers
    restored = corruption.restore([all_layers(len(layers))])
    assert restored.is_defined
    # what is read off the prompt behind the layers does without the hidden word all the same
    tolerance = 1e-3 if layers_decide(name) else 0.5
    assert float(restored.ratios) == pytest.approx(1, abs=tolerance)
    corrupt = corruption.restore_corrupt([[unit] for unit in all_heads(layers)])
    assert corrupt.ratios.tolist() == pytest.approx([0] * len(all_heads(layers)), abs=1e-3)


def layers_decide(name: str) -> bool:
    """Return True if nothing else of the prompt reaches the answer: no mean of its states does."""
    return getattr(loaded(name).config, "reasoning_pool", None) is None


@pytest.mark.parametrize("name", NAMES)
def test_any_one_layer_put_back_at_all_tokens_is_the_clean_score(name: str) -> None:
    layers = scored_by(loaded(name)).layers
    for corruption in corruptions(name):
        assert corruption.restore_each(all_layers(len(layers))).tolist() == pytest.approx(
            [1] * len(layers), abs=1e-3
        )


@pytest.mark.parametrize("name", NAMES)
def test_the_spans_are_all_of_the_sequence_but_what_never_changes(name: str) -> None:
    corruption = corruptions(name)[0]
    explained = scored_by(loaded(name))
    rows = explained.encode(loaded(name).prepare(ask(loaded(name)).observation))
    spans = explained.token_spans(rows)
    assert {WORKSPACE, WRIST, "instruction", "answer"} <= spans.keys()
    units = [Unit(0, LAYER, span=span) for span in spans.values()]
    # with the first layer's states put back everywhere, nothing corrupt is left
    assert float(corruption.restore([units]).ratios) == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize("name", NAMES)
def test_units_put_back_in_a_batch_give_what_they_give_alone(name: str) -> None:
    corruption = corruptions(name)[1]
    units = all_heads(scored_by(loaded(name)).layers)
    alone = torch.cat([corruption.restore([[unit]]).scores for unit in units])
    together = corruption.restore([[unit] for unit in units]).scores
    torch.testing.assert_close(together, alone, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_nothing_is_put_back_of_an_instruction_of_more_tokens(name: str) -> None:
    """Pad both to as many columns, as on CUDA, where instructions are padded."""
    policy, instruction = loaded(name), moment()[1]

    def prepare(batch: dict[str, Any]) -> dict[str, Any]:
        prepared = policy.prepare(batch)
        keys = ("observation.language.tokens", "observation.language.attention_mask")
        return prepared | {key: pad(prepared[key], (0, 32 - prepared[key].shape[1])) for key in keys}

    others = {"longer": f"{instruction} please", "as long": moment()[3]["row"][0]}
    for other, is_put_back in zip(others.values(), (False, True), strict=True):
        found = explain(ask(policy, prepare), replace(query(policy), others={"other": other}))
        assert any(OTHER_INSTRUCTION in each.corruption for each in found.restored) == is_put_back


def hooks_of(name: str) -> int:
    return sum(
        len(module._forward_hooks) + len(module._forward_pre_hooks)
        for module in loaded(name).policy.modules()
    )


@pytest.mark.parametrize("name", NAMES)
def test_hooks_are_gone_afterwards_also_after_an_error(name: str) -> None:
    before = hooks_of(name)
    corruption = corruptions(name)[0]
    corruption.restore_each(all_mlps(1))
    layers = scored_by(loaded(name)).layers
    with pytest.raises(RuntimeError), recording(layers, PARTS):
        assert hooks_of(name) > before
        raise RuntimeError
    assert hooks_of(name) == before


def test_a_corruption_that_changes_nothing_has_no_ratio() -> None:
    assert Restoration(-3.0, -3.0, torch.tensor([-3.0])).ratios.isnan().all()
    assert Restoration(-3.0, -4.0, torch.tensor([-3.5])).ratios.tolist() == [0.5]


def test_a_batch_of_one_becomes_as_many_as_asked() -> None:
    batch = {"image": torch.zeros(1, 3), "task": ["go"], "number": torch.tensor(1.0), "info": {}}
    three = repeated(batch, 3)
    assert three["image"].shape == (3, 3) and three["task"] == ["go"] * 3
    assert three["number"].ndim == 0 and three["info"] == {}


def test_samples_are_not_explained() -> None:
    policy: Any = loaded("vla0_smol").policy
    policy.config.temperature = 0.5
    try:
        with pytest.raises(ValueError, match=r"--policy\.temperature=0"):
            policy.scored()
    finally:
        policy.config.temperature = 0.0
