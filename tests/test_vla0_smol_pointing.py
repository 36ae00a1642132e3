"""`vla0_smol` points, then acts: numbers before the actions, learned, never hidden, and obeyed."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from relative_cases import NAMES, make_dataset
from torch import Tensor
from torch.nn.functional import cross_entropy
from vla0_smol_cases import WORKSPACE, make_batch, make_config, make_policy, numbers_of, sequence

from lerobot_bomb.actions.text import END, IGNORED, SPACE, NumberTokens, TokenRows
from lerobot_bomb.decoding.decoder import Prompt
from lerobot_bomb.decoding.draft import KnownSymbols
from lerobot_bomb.decoding.grammar import NumberGrammar
from lerobot_bomb.decoding.writer import NumberWriter
from lerobot_bomb.flag_errors import FlagError
from lerobot_bomb.policies.pointing import OTHER_ACTIONS, OTHER_PLACES, PLACE, STONE
from lerobot_bomb.vlm.tokenizer import load_tokenizer
from lerobot_policy_bomb.vla0_smol.modeling_vla0_smol import Vla0SmolPolicy
from lerobot_policy_bomb.vla0_smol.pointing_vla0_smol import NUM_NUMBERS

# a millimetre a bin, and three digits each; without reading the board: that is in test_board_reader.py
POINTING: dict[str, Any] = {
    "pointing": True,
    "board_loss_weight": 0.0,
    "n_action_bins": 601,
    "bin_mode": "levels",
    "number_width": 3,
}
PLACES = torch.tensor([[-0.09, 0.09], [0.0, -0.15], [0.09, 0.03], [0.15, -0.06]])


def pointing_policy(**options: Any) -> Vla0SmolPolicy:
    return make_policy(**POINTING | options)


def pointing_batch(policy: Vla0SmolPolicy, batch_size: int = 4) -> dict[str, Any]:
    """Places in turn, the next two as other places; an action leads to its place, from the board's centre."""
    batch, steps = make_batch(policy, batch_size), policy.config.chunk_size
    number_B = torch.arange(batch_size) % len(PLACES)
    others_B22 = PLACES[torch.stack([number_B + 1, number_B + 2], dim=1) % len(PLACES)]
    return batch | {
        PLACE: PLACES[number_B],
        STONE: torch.cat([-PLACES[number_B], torch.zeros(batch_size, 1)], dim=1),
        OTHER_PLACES: others_B22.flatten(1),
        OTHER_ACTIONS: towards(others_B22).flatten(1),
        "action": towards(PLACES[number_B])[:, None].repeat(1, steps, 1),
        "action_is_pad": torch.zeros(batch_size, steps, dtype=torch.bool),
        "observation.state": torch.zeros(batch_size, 4),
    }


def towards(xy: Tensor) -> Tensor:
    """(..., 2) metres -> (..., 4) actions that are bins of their own, whatever the rounding."""
    return torch.cat([xy / 0.3, torch.zeros_like(xy)], dim=-1)


def labelled(policy: Vla0SmolPolicy, numbers: NumberTokens) -> list[list[bool]]:
    """Return for each row and number whether all of its digits carry loss."""
    return numbers.loss_mask[..., 1:].all(dim=2).tolist()


# Sequence


@pytest.mark.parametrize(
    ("width", "answer"),
    [
        (0, " 350 200 390 255 360 255 450 0 300 600<end_of_utterance>"),
        (4, " 0350 0200 0390 0255 0360 0255 0450 0000 0300 0600<end_of_utterance>"),
    ],
)
def test_an_answer_begins_with_stone_place_and_the_way_there(width: int, answer: str) -> None:
    """Stone at (50, -100) mm, place at (90, -45) mm, gripper at (30, 0) mm; 300 is the middle."""
    options = {"number_width": width, "chunk_size": 1, "n_action_steps": 1}
    policy, plain = pointing_policy(**options), make_policy(**POINTING | options | {"pointing": False})
    batch = pointing_batch(policy, 1) | {
        STONE: torch.tensor([[0.05, -0.1, 1.0]]),
        PLACE: torch.tensor([[0.09, -0.045]]),
        "observation.state": torch.tensor([[0.03, 0.0, 0.5, -1.0]]),
        "action": torch.tensor([[[0.5, -1.0, 0.0, 1.0]]]),
    }
    (ids,), (plain_ids,) = sequence(policy, batch), sequence(plain, batch)
    expected = load_tokenizer("nano").encode(answer).ids
    assert ids[-len(expected) :] == expected
    # without pointing: the same prompt, the actions alone
    num_prompt, num_pointing = len(ids) - len(expected), NUM_NUMBERS * (1 + (width or 3))
    assert plain_ids == ids[:num_prompt] + ids[num_prompt + num_pointing :]


def test_the_grammar_has_six_numbers_and_then_the_actions() -> None:
    policy = pointing_policy(number_width=0)
    symbols = [symbol for number in range(6 + 12) for symbol in (SPACE, 9 - number % 5)] + [END]
    places = policy.grammar.walk(policy.grammar.start(1), torch.tensor([symbols[1:]]))
    allowed = (policy.grammar.logit_bias(places)[0] == 0).tolist()
    for column, symbol in enumerate(symbols[1:]):
        assert allowed[column][symbol], column
        assert allowed[column][END] == (symbol == END), column


def test_off_there_is_nothing_of_it() -> None:
    policy = make_policy()
    assert policy.pointer is None and not any("point" in name for name in policy.state_dict())
    batch = make_batch(policy, 2)
    seen = pointing_batch(policy, 2) | {key: batch[key] for key in ("action", "observation.state")}
    assert sequence(policy, seen) == sequence(policy, batch)
    policy.config.mask_max_fraction = 0.5
    losses = []
    for each in (batch, seen):
        policy.config.trained_batches = 0  # which all that is random in a batch follows from
        losses.append(policy.train()(each)[0])
    assert torch.equal(*losses)
    assert policy.write(batch, 3).shape == (2, 12)
    assert "stone and destination predicted first" not in policy.config.methods_used()
    # a checkpoint of before keeps its identity
    later = {name: getattr(policy.config, name) for name in policy.config.LATER_FIELDS}
    expected = {"counterfactual_share": 0.5, "board_loss_weight": 1.0, "pointing_loss_weight": 1.0}
    expected |= {"pointing_range_m": 0.3, "optimizer": "adamw"}
    assert later == {"pointing": False, **expected} == policy.config.LATER_FIELDS


# Loss


def test_what_is_meant_is_trained_on() -> None:
    policy = pointing_policy(counterfactual_share=0.0, mask_max_fraction=0.0).train()
    batch = pointing_batch(policy)
    batch["action_is_pad"][0, 2] = True
    numbers = numbers_of(policy, batch)
    assert labelled(policy, numbers) == [14 * [True] + 4 * [False], *3 * [18 * [True]]]
    assert numbers.loss_mask[1:].all()


@torch.no_grad()
def test_a_weight_counts_the_loss_of_pointing_more_than_that_of_actions() -> None:
    policy = pointing_policy(pointing_loss_weight=3.0)
    batch = pointing_batch(policy)
    numbers = policy._numbers(*policy._targets(batch))
    answer = policy._answer(numbers)
    logits_BAV = policy._answer_logits(policy.encode_images(batch), policy.prompt(batch), answer.rows)
    losses_BA = cross_entropy(logits_BAV.mT, answer.labels, ignore_index=IGNORED, reduction="none")
    weights_BA = torch.where(answer.columns < NUM_NUMBERS * (1 + 3), 3, 1)
    expected = (weights_BA * losses_BA).sum() / (answer.labels != IGNORED).sum()
    assert float(policy(batch)[0]) == pytest.approx(float(expected), rel=1e-5)
    assert 0 < float((weights_BA == 1).float().mean()) < 1


def test_of_another_place_the_way_and_later_actions_are_not() -> None:
    policy = pointing_policy(counterfactual_share=1.0, mask_max_fraction=0.0).train()
    batch = pointing_batch(policy)
    bins_BN, loss_mask_BN = policy._targets(batch)
    numbers = policy._numbers(bins_BN, loss_mask_BN)
    meant, way, first, later = 4 * [True], 2 * [False], 4 * [True], 8 * [False]
    assert labelled(policy, numbers) == 4 * [meant + way + first + later]
    # a space says that the number before it ends
    ends_meant, ends_way, ends_first = 5 * [True], 2 * [False], 3 * [True]
    assert numbers.loss_mask[..., 0].tolist() == 4 * [ends_meant + ends_way + ends_first + later]
    labels = policy._answer(numbers).labels
    assert (labels != IGNORED).sum(dim=1).tolist() == 4 * [5 + 3 * 4 + 3 + 3 * 4 + 1]  # and the end
    for row in range(4):
        place, *given = [tuple(bins) for bins in bins_BN[row, 2:10].view(4, 2).tolist()]
        meant, *others = [
            tuple((1000 * PLACES[(row + i) % 4] + 300).round().int().tolist()) for i in range(3)
        ]
        assert place == meant and given[0] in others  # as ways, because the gripper is at the centre
        # its action; later ones are those of the demonstration
        assert given[1:] == [given[0], (300, 300)]
        assert policy.action_bins.decode(bins_BN[row, 10:]).allclose(batch["action"][row, 1:].flatten())


def test_evaluation_is_of_what_is_meant() -> None:
    policy = pointing_policy(counterfactual_share=1.0)
    batch = pointing_batch(policy)
    assert labelled(policy, numbers_of(policy, batch)) == 4 * [18 * [True]]
    assert torch.equal(policy(batch)[0], policy(batch)[0])


@pytest.mark.parametrize("level", ["value", "step", "char"])
def test_what_is_pointed_at_is_never_hidden(level: str) -> None:
    policy = pointing_policy(mask_level=level, mask_max_fraction=1.0, mask_skip_prob=0.0).train()
    hidden = numbers_of(policy, pointing_batch(policy, 16)).ids == policy.tokens.hidden
    assert not hidden[:, :NUM_NUMBERS].any()
    assert hidden[:, NUM_NUMBERS:].any()


@pytest.mark.parametrize(("wrong", "accuracy"), [("pointing", 1.0), ("actions", 0.0)])
def test_metrics_of_actions_leave_it_out(
    wrong: str, accuracy: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A model that writes some numbers a bin too high."""
    policy = pointing_policy()
    batch = pointing_batch(policy)
    bins_BN = policy._targets(batch)[0]
    bins_BN[:, slice(None, 6) if wrong == "pointing" else slice(6, None)] += 1
    ids = policy._answer(policy._to_tokens(bins_BN, 601)).rows.ids
    logits = torch.nn.functional.one_hot(ids, policy.backbone.text_config.vocab_size).float()
    monkeypatch.setattr(policy, "_answer_logits", lambda *_: logits)
    metrics = policy(batch)[1]
    assert metrics["value_accuracy"] == accuracy and (metrics["token_accuracy"] == 1) == bool(accuracy)
    error_m = 0.001 if wrong == "pointing" else 0.0
    assert metrics["stone_l1_m"] == pytest.approx(error_m, abs=1e-6)
    assert metrics["place_l1_m"] == pytest.approx(error_m, abs=1e-6)


# Answers


def test_actions_alone_come_out_whatever_the_decoding() -> None:
    policy = pointing_policy()
    undrafted = pointing_policy(draft="none")
    ensemble = pointing_policy(temporal_ensemble_size=2, n_action_steps=1)
    batch = make_batch(policy, 3)  # no labels
    written = policy.write(batch, 3)
    assert written.shape == (3, 18)
    chunk = policy.predict_action_chunk(batch)
    assert torch.equal(chunk, policy.action_bins.decode(written[:, 6:]).view(3, 3, 4))
    assert torch.equal(undrafted.predict_action_chunk(batch), chunk)
    assert torch.equal(torch.stack([policy.select_action(batch) for _ in range(2)], dim=1), chunk[:, :2])
    assert policy._decoded is not None and policy._decoded.numbers.shape == (3, 14)  # what is executed
    torch.testing.assert_close(ensemble.select_action(batch), chunk[:, 0])
    torch.testing.assert_close(ensemble.select_action(batch), (chunk[:, 0] + chunk[:, 1]) / 2)
    for row in range(3):
        one: Any = {
            key: value[row : row + 1] if isinstance(value, Tensor | list) else value
            for key, value in batch.items()
        }
        assert torch.equal(policy.predict_action_chunk(one)[0], chunk[row])


def forced(policy: Vla0SmolPolicy, batch: dict[str, Any], given_B2: Tensor) -> Tensor:
    """(B, D) the actions that it writes after the way to a place that it is made to write."""
    assert policy.pointer is not None
    bins = policy.config.n_action_bins
    labels = policy.pointer.labels(batch, 0.0, "vla0_smol", policy.generator)
    labels = replace(labels, given_xy=given_B2)
    tokens = policy._to_tokens(policy.pointer.bins_of(labels, batch["observation.state"]), bins)
    pointed = TokenRows(tokens.ids.flatten(1), tokens.mask.flatten(1))
    rows = TokenRows.join([policy.eval().prompt(batch), pointed]).without_padding()
    grammar = NumberGrammar(bins, 4, fixed_width=policy.config.number_width)
    write = NumberWriter(policy.backbone, grammar, KnownSymbols(grammar), policy._positions)
    decoded = write(
        Prompt(policy.embed(rows.ids, policy.encode_images(batch)), rows.mask), policy.symbol_ids, 4
    )
    return policy.action_bins.decode(decoded.numbers)


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_it_learns_to_point_and_given_other_places_goes_where_it_points(share: float) -> None:
    sizes = {"n_action_bins": 21, "n_state_bins": 21, "number_width": 2, "chunk_size": 1, "n_action_steps": 1}
    plain = {"cameras": (WORKSPACE,), "crop_fraction": 1.0, "mask_max_fraction": 0.0}
    policy = pointing_policy(**sizes, **plain, counterfactual_share=share)
    batch = pointing_batch(policy)
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=2e-3, weight_decay=0.0)
    for _ in range(80):
        loss, _ = policy.train()(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    with torch.no_grad():
        policy.eval()
        assert torch.equal(policy.write(batch, 1), policy._targets(batch)[0])
        for turn in (1, 2):  # places that other rows mean
            given_B2 = PLACES.roll(-turn, dims=0)
            is_obeyed = (forced(policy, batch, given_B2) - towards(given_B2)).abs().max() < 1e-5
            assert is_obeyed == (share > 0), turn


def test_an_explanation_is_of_the_whole_answer() -> None:
    policy = pointing_policy()
    explained, batch = policy.scored(), make_batch(policy, 1)
    answer, rows = explained.answer(batch), explained.encode(batch)
    assert answer.shape == (1, 18)
    moved = answer.clone()
    moved[:, 2] = (moved[:, 2] + 300) % 601  # the place
    assert explained.score(rows, answer) > explained.score(rows, moved)


def test_an_explanation_says_where_it_points() -> None:
    """Check its millimetres, of which 300 is the middle."""
    policy = pointing_policy()
    batch = make_batch(policy, 1)
    numbers = policy.write(batch, 3)[0].tolist()
    found = policy.scored().pointed(batch)
    assert found is not None and found.held is None and found.probabilities == {}
    assert len({*numbers[:4]}) > 1
    xy_m = [(number - 300) / 1000 for number in numbers[:4]]
    assert [*found.stone_xy, *found.place_xy] == pytest.approx(xy_m, abs=1e-6)
    plain = make_policy()
    assert plain.scored().pointed(make_batch(plain, 1)) is None


# Data


def pointing_dataset(root: Path, stones_x: Sequence[float] = (0.05, 0.05, 0.05)) -> LeRobotDatasetMetadata:
    """Write frames, their gripper at the low end, in the middle and at the high end of its range in turn."""
    sizes = {PLACE: 2, STONE: 3, OTHER_PLACES: 4, OTHER_ACTIONS: 8}
    features: dict[str, Any] = {
        key: {"dtype": "float32", "shape": (size,), "names": None} for key, size in sizes.items()
    }
    for key in ("observation.state", "action"):
        features[key] = {"dtype": "float32", "shape": (4,), "names": NAMES}
    dataset = LeRobotDataset.create("test/points", fps=10, features=features, root=root, use_videos=False)
    states = [-0.1, -0.2, 0.0, 0.0], [0.0, 0.0, 0.05, 1.0], [0.1, 0.2, 0.1, 1.0]
    for state, stone_x in zip(cycle(states), stones_x, strict=False):
        frame: dict[str, Any] = {key: np.full(size, 0.05, np.float32) for key, size in sizes.items()}
        frame[STONE][0] = stone_x
        frame["observation.state"] = np.array(state, np.float32)
        frame["action"] = np.array(
            [2 * state[0], state[1], state[2], 0.5], np.float32
        )  # the last is constant
        dataset.add_frame({**frame, "task": "place"})
    dataset.save_episode()
    dataset.finalize()
    return LeRobotDatasetMetadata("test/points", root=root)


def build(meta: LeRobotDatasetMetadata | None, **options: Any) -> Vla0SmolPolicy:
    return Vla0SmolPolicy(make_config(**POINTING | options), dataset_meta=meta).eval()


def test_units_are_the_datasets_and_kept(tmp_path: Path) -> None:
    meta = pointing_dataset(tmp_path / "data")
    policy = build(meta)
    policy.save_pretrained(tmp_path / "checkpoint")
    for each in (policy, Vla0SmolPolicy.from_pretrained(tmp_path / "checkpoint")):
        assert each.pointer is not None
        gripper = each.pointer.gripper(torch.tensor([[0.0, 1.0, -1.0, 0.0]]))
        torch.testing.assert_close(gripper, torch.tensor([[0.0, 0.2, 0.0]]))
        normalised = each.pointer.normalised(torch.tensor([[0.1, -0.2, 0.1, 0.5]]))
        torch.testing.assert_close(normalised, torch.tensor([[0.5, -1.0, 1.0, -1.0]]))
    batch = make_batch(policy, 2)
    again = Vla0SmolPolicy.from_pretrained(tmp_path / "checkpoint").eval()
    assert torch.equal(policy.predict_action_chunk(batch), again.predict_action_chunk(batch))


def test_labels_are_of_training_only() -> None:
    policy = pointing_policy()
    policy.predict_action_chunk(make_batch(policy, 1))
    with pytest.raises(KeyError, match=r"vla0_smol needs 'observation\.pointing\.place'"):
        policy(make_batch(policy, 1))


LACKS = (
    r"trained on the columns observation\.pointing\.place, .* which test/relative lacks; lerobot-bomb record"
)


def test_a_dataset_that_does_not_point_is_refused(tmp_path: Path) -> None:
    plain = make_dataset(tmp_path / "plain", 0.1)
    with pytest.raises(ValueError, match=LACKS):
        build(plain)
    build(pointing_dataset(tmp_path / "data")).save_pretrained(tmp_path / "checkpoint")
    with pytest.raises(ValueError, match=LACKS):
        Vla0SmolPolicy.from_pretrained(tmp_path / "checkpoint", dataset_meta=plain)


@pytest.mark.parametrize(("began", "is_old"), [(False, False), (False, True), (True, False)])
def test_a_checkpoint_goes_on_as_it_began(tmp_path: Path, began: bool, is_old: bool) -> None:
    """Old ones do not name the flag."""
    meta = pointing_dataset(tmp_path / "data")
    build(meta, pointing=began).save_pretrained(tmp_path / "checkpoint")
    flags = [f"--pointing={str(not began).lower()}"]
    config: Any = PreTrainedConfig.from_pretrained(tmp_path / "checkpoint", cli_overrides=flags)
    if is_old:
        del config.trained_with["pointing"]
    flag = rf"--policy\.pointing={not began}"
    with pytest.raises(ValueError, match=f"{flag}: the weights of this checkpoint are made for {began}"):
        Vla0SmolPolicy.from_pretrained(tmp_path / "checkpoint", config=config, dataset_meta=meta)
    with pytest.raises(ValueError, match=f"{flag}: this checkpoint was trained with {began}"):
        Vla0SmolPolicy.from_pretrained(tmp_path / "checkpoint", config=config)


def test_a_stone_that_fell_off_the_table_is_cut_to_the_range(tmp_path: Path) -> None:
    lost, others = [0.6], 199 * [0.05]
    policy = build(pointing_dataset(tmp_path / "own_episodes", others + lost))
    assert policy.pointer is not None
    batch = pointing_batch(policy)
    labels = policy.pointer.labels(batch, 0.0, "vla0_smol", policy.generator)
    far, edge = (replace(labels, stone_xy=torch.full_like(labels.stone_xy, x)) for x in (0.6, 0.3))
    state = batch["observation.state"]
    assert torch.equal(policy.pointer.bins_of(far, state), policy.pointer.bins_of(edge, state))
    meta = pointing_dataset(tmp_path / "other_units", others + 3 * lost)
    with pytest.raises(ValueError, match=r"pointing_range_m=0\.3: .*stone of test/points is up to 0\.6 m"):
        build(meta)


def test_another_range_would_mean_other_places(tmp_path: Path) -> None:
    meta = pointing_dataset(tmp_path / "data")
    with pytest.raises(ValueError, match=r"pointing_range_m=0\.04: .* of test/points is up to 0\.05 m"):
        build(meta, pointing_range_m=0.04)
    build(meta).save_pretrained(tmp_path / "checkpoint")
    flags = ["--pointing_range_m=0.4"]
    config: Any = PreTrainedConfig.from_pretrained(tmp_path / "checkpoint", cli_overrides=flags)
    with pytest.raises(ValueError, match=r"--policy\.pointing_range_m=0\.4: this checkpoint was trained"):
        Vla0SmolPolicy.from_pretrained(tmp_path / "checkpoint", config=config)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"counterfactual_share": -0.5}, r"--policy\.counterfactual_share=-0\.5 must lie in 0\.\.1"),
        ({"pointing_range_m": 0.0}, r"--policy\.pointing_range_m=0\.0 must be finite and greater than 0"),
        ({"pointing_range_m": float("nan")}, r"--policy\.pointing_range_m=nan must be finite"),
    ],
)
def test_wrong_flags_are_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(FlagError, match=message):
        make_config(**POINTING | options)


def test_it_needs_the_robots_state() -> None:
    config = make_config(**POINTING, use_state=False)
    del (config.input_features or {})["observation.state"]
    with pytest.raises(ValueError, match=r"--policy\.pointing=true needs the feature 'observation\.state'"):
        Vla0SmolPolicy(config)
