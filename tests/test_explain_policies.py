"""LeRobot's own policies, explained as far as they can be."""

from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.factory import get_policy_class, make_policy_config, make_pre_post_processors
from stock_policies import FLAGS, shrink_gemma, write_folders

from lerobot_bomb.explain.activations import all_heads, all_layers, all_mlps
from lerobot_bomb.explain.images import filling, patch_masks
from lerobot_bomb.explain.other_policies import scored
from lerobot_bomb.explain.question import Question
from lerobot_bomb.explain.restoration import Corruption
from lerobot_bomb.explain.spans import span_of, token_offsets

KEY, TASK = "observation.images.workspace", "Place a black stone at row 1, column 2."
READ = ("smolvla", "pi0")


@pytest.fixture(params=["act", *READ])
def asked(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> tuple[str, Question, Any]:
    """A small policy of random weights, a question to it, its preprocessor."""
    stock_type: str = request.param
    monkeypatch.chdir(tmp_path)
    write_folders(tmp_path)
    if stock_type.startswith("pi"):
        shrink_gemma(monkeypatch, stock_type)
    visual, state = PolicyFeature(FeatureType.VISUAL, (3, 64, 64)), PolicyFeature(FeatureType.STATE, (4,))
    inputs = {KEY: visual, "observation.state": state}
    outputs = {"action": PolicyFeature(FeatureType.ACTION, (4,))}
    own = {name: tuple(each) if isinstance(each, list) else each for name, each in FLAGS[stock_type].items()}
    config: Any = make_policy_config(
        stock_type, device="cpu", push_to_hub=False, input_features=inputs, output_features=outputs, **own
    )
    torch.manual_seed(0)
    policy = get_policy_class(stock_type)(config).eval()
    unit = {"mean": torch.zeros(4), "std": torch.ones(4), "min": -torch.ones(4), "max": torch.ones(4)}
    pixels = {"mean": torch.zeros(3, 1, 1), "std": torch.ones(3, 1, 1)}
    stats = {"observation.state": unit, "action": unit, KEY: pixels}
    prepare, postprocess = make_pre_post_processors(config, dataset_stats=stats)
    generator = torch.Generator().manual_seed(0)
    observation = {
        KEY: torch.rand(1, 3, 64, 64, generator=generator),
        "observation.state": torch.zeros(1, 4),
        "task": [TASK],
    }
    return stock_type, Question(scored(policy, postprocess), prepare, observation), prepare


def test_what_is_as_it_was_has_no_effect_and_an_empty_image_has_one(asked: tuple) -> None:
    _, question, _ = asked
    (image,) = question.observation[KEY]
    filled = filling(image, "mean", 1.0)
    nothing = torch.zeros(1, 64, 64, dtype=torch.bool)
    assert question.effects_of_masks(KEY, nothing, filled).abs().max() < 1e-5
    assert question.effects_of_masks(KEY, ~nothing, filled).abs().max() > 1e-6


def test_rows_beside_it_change_no_score(asked: tuple) -> None:
    _, question, prepare = asked
    (image,) = question.observation[KEY]
    masks, filled = patch_masks(2, 64, 64), filling(image, "mean", 1.0)
    alone = Question(question.policy, prepare, question.observation, batch_size=1)
    torch.testing.assert_close(
        question.effects_of_masks(KEY, masks, filled),
        alone.effects_of_masks(KEY, masks, filled),
        rtol=0,
        atol=1e-5,
    )


def test_words_can_be_hidden_from_one_that_reads(asked: tuple) -> None:
    stock_type, question, prepare = asked
    if stock_type not in READ:
        with pytest.raises(ValueError, match="act reads no instruction"):
            question.effects_of_hidden(torch.ones(1, 4, dtype=torch.bool))
        with pytest.raises(ValueError, match="reads no instruction"):
            token_offsets(prepare.steps, TASK)
        assert not question.policy.layers
        return
    hidden = span_of("column 2", TASK).tokens(token_offsets(prepare.steps, TASK))
    effects = question.effects_of_hidden(torch.stack([hidden, torch.zeros_like(hidden)]))
    assert abs(effects[0]) > 1e-7 and abs(effects[1]) < 1e-6


def test_heads_and_mlps_can_be_put_back_but_not_layers(asked: tuple) -> None:
    stock_type, question, _ = asked
    if stock_type not in READ:
        return
    (image,) = question.observation[KEY]
    corrupt = question.encode({KEY: filling(image, "mean", 1.0)[None]}, 1)
    corruption = Corruption(question, corrupt)
    layers = question.policy.layers
    units = [*all_heads(layers), *all_mlps(len(layers))]
    scores = corruption.restore_corrupt([[unit] for unit in units]).scores
    torch.testing.assert_close(scores, torch.full_like(scores, corruption.score), rtol=0, atol=1e-5)
    restored = corruption.restore([units]).scores
    assert abs(float(restored) - corruption.score) > 1e-6
    with pytest.raises(ValueError, match="one by one"):
        corruption.restore([all_layers(1)])


def test_what_a_policy_draws_is_its_own_again_afterwards(asked: tuple) -> None:
    stock_type, question, _ = asked
    if stock_type in READ:
        model = question.policy._policy.model  # pyright: ignore[reportAttributeAccessIssue]
        assert not {"sample_noise", "sample_time"} & vars(model).keys()
