import math

import pytest
import torch
from torch import Tensor
from vla0_smol_cases import make_batch, make_policy

from lerobot_bomb.actions.accuracy import counted_numbers, exact_numbers, means, read_numbers
from lerobot_bomb.actions.text import NumberTokens, number_symbols
from lerobot_policy_bomb.vla0_smol.modeling_vla0_smol import Vla0SmolPolicy

END = 11


def tokens(*numbers: int) -> NumberTokens:
    """One row of numbers of up to three digits; symbols serve as token ids."""
    symbols, written = number_symbols(torch.tensor([numbers]), 3, zero_padded=False)
    return NumberTokens(symbols, written, written)


def predicted(numbers: NumberTokens, **changes: int) -> Tensor:
    """The true symbols of all columns, with `c5=7` in column 5."""
    symbols = torch.cat([numbers.ids.flatten(1), torch.tensor([[END]])], dim=1)
    for column, symbol in changes.items():
        symbols[0, int(column[1:])] = symbol
    return symbols


# columns: space 5 1 2 | space _ _ 7 | end
NUMBERS = tokens(512, 7)


@pytest.mark.parametrize(
    ("changes", "exact", "read"),
    [
        ({}, [True, True], [512, 7]),
        ({"c2": 9}, [False, True], [592, 7]),
        ({"c7": 3}, [True, False], [512, 3]),
        ({"c8": 0}, [True, False], [512, 7]),  # a digit in place of the end: 70
        ({"c4": 4}, [False, True], [512, 7]),  # a digit in place of the next space: 5124
        ({"c5": 1, "c0": 1}, [True, True], [512, 7]),  # a gap; the space before is the model's first token
    ],
)
def test_numbers_from_predicted_symbols(changes: dict[str, int], exact: list[bool], read: list[int]) -> None:
    symbols = predicted(NUMBERS, **changes)
    right = symbols == predicted(NUMBERS)
    assert exact_numbers(NUMBERS, right)[0].tolist() == exact
    assert read_numbers(NUMBERS, symbols)[0].tolist() == read


def test_hidden_and_padded_numbers_do_not_count() -> None:
    hidden = NUMBERS.hide_numbers(torch.tensor([[True, False]]), hidden_id=99)
    assert counted_numbers(hidden).tolist() == [[False, True]]
    padded = NumberTokens(NUMBERS.ids, NUMBERS.mask, torch.zeros_like(NUMBERS.mask))
    assert counted_numbers(padded).tolist() == [[False, False]]
    one_digit = torch.zeros_like(NUMBERS.mask)
    one_digit[0, 0, 2] = True
    assert counted_numbers(NUMBERS.hide_characters(one_digit, 99)).tolist() == [[False, True]]


def test_means_are_zero_where_nothing_counts() -> None:
    values = torch.tensor([1.0, 2.0, 6.0])
    none = torch.zeros(3, dtype=torch.bool)
    counted = torch.tensor([True, False, True])
    assert means({"a": (values, counted), "b": (values, none)}, values, 0) == {"a": 3.5, "b": 0.0}


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_training_that_diverged_says_so(bad: float) -> None:
    counted = torch.ones(2, dtype=torch.bool)
    with pytest.raises(ValueError, match=r"loss is not finite .* after 7 batches of training"):
        means({"a": (torch.ones(2), counted)}, torch.tensor([1.0, bad]), 7)


def told(
    policy: Vla0SmolPolicy, batch: dict, monkeypatch: pytest.MonkeyPatch, off_by: int
) -> dict[str, float]:
    """Metrics of a model that writes every number `off_by` bins too high."""
    numbers = policy._to_tokens(policy._targets(batch)[0] + off_by, policy.config.n_action_bins)
    answer = policy._answer(numbers)
    logits = torch.nn.functional.one_hot(answer.rows.ids, policy.backbone.text_config.vocab_size).float()
    monkeypatch.setattr(policy, "_answer_logits", lambda *_: logits)
    return policy(batch)[1]


@pytest.mark.parametrize(("off_by", "exact"), [(0, 1.0), (1, 0.0)])
def test_metrics_of_a_policy(monkeypatch: pytest.MonkeyPatch, off_by: int, exact: float) -> None:
    policy = make_policy(
        n_action_bins=101, bin_mode="levels", number_width=3, action_feature_names=["x", "y", "z", "grip"]
    )
    policy.action_unit.copy_(torch.tensor([1.0, 10.0, 100.0, 0.5]))
    policy._action_names = policy.config.action_names
    batch = make_batch(policy, 4)
    batch["action"] = batch["action"] * 0.9  # one bin more stays in range
    metrics = told(policy, batch, monkeypatch, off_by)
    # a level is 0.02 of the normalised action
    sizes = {f"l1_{name}": 0.02 * off_by * unit for name, unit in zip("xyz", (1, 10, 100), strict=True)}
    expected = {"l1": 0.02 * off_by * 111.5 / 4, **sizes, "l1_grip": 0.01 * off_by}
    assert {name: metrics[name] for name in expected} == pytest.approx(expected, abs=1e-5)
    assert metrics["value_accuracy"] == exact
    assert (metrics["token_accuracy"] == 1.0) == bool(exact)


def test_padded_steps_do_not_enter_the_metrics(monkeypatch: pytest.MonkeyPatch) -> None:
    policy = make_policy(n_action_bins=101, bin_mode="levels", number_width=3)
    policy._action_names = policy.config.action_names
    batch = make_batch(policy, 1)
    right = policy._targets(batch)[0]
    batch["action_is_pad"][0, 1:] = True
    batch["action"][0, 1:] = -batch["action"][0, 1:]
    logits = torch.nn.functional.one_hot(
        policy._answer(policy._to_tokens(right, 101)).rows.ids, policy.backbone.text_config.vocab_size
    )
    monkeypatch.setattr(policy, "_answer_logits", lambda *_: logits.float())
    metrics = policy(batch)[1]
    assert metrics["l1"] == 0 and metrics["value_accuracy"] == 1


def test_without_statistics_there_is_no_physical_error() -> None:
    policy = make_policy()
    assert set(policy(make_batch(policy, 2))[1]) == {"token_accuracy", "value_accuracy"}
