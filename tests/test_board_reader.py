"""Reading of the board off image tokens, learned beside pointing by all three policies."""

import math
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import spatialvla_grid_pointing_cases
import test_fdvla_pointing
import test_vla0_smol_pointing
import torch
from lerobot.configs import PreTrainedConfig
from policy_cases import CASES
from spatialvla_grid_pointing_cases import make_dataset
from torch import Tensor

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.observation import RenderOptions
from lerobot_bomb.bomb.pointing import SPOTS_XY_M, Pointing, colors_on_spots
from lerobot_bomb.bomb.privileged_state import PrivilegedState
from lerobot_bomb.bomb.suite import find_suite
from lerobot_bomb.envs.rollout import make_env
from lerobot_bomb.flag_errors import FlagError
from lerobot_bomb.policies.board_reader import NUM_SPOTS, BoardReader
from lerobot_bomb.policies.pointing import SPOTS

SMALL = RenderOptions(image_size=32)
POINTING: dict[str, ModuleType] = {
    "fdvla": test_fdvla_pointing,
    "spatialvla_grid": spatialvla_grid_pointing_cases,
    "vla0_smol": test_vla0_smol_pointing,
}
# what the families call them
VISION = ("vision_model", "vision_tower", "visual")
TEXT = ("text_model", "language_model")
# 20 intersections are empty, 3 black, 2 white
BOARD = torch.tensor([*(3 * [1] + 2 * [2]), *((NUM_SPOTS - 5) * [0])])


def reading_policy(policy_type: str, **options: Any) -> Any:
    return POINTING[policy_type].pointing_policy(**{"board_loss_weight": 1.0, **options})


def board_batch(policy: Any, batch_size: int = 4) -> dict[str, Any]:
    """Labels of pointing, and a board that is turned on a little from row to row."""
    boards = torch.stack([BOARD.roll(row) for row in range(batch_size)])
    batch = POINTING[policy.name].pointing_batch(policy, batch_size)
    return batch | {SPOTS: boards.float()}


def gradients(policy: Any, batch: dict[str, Any], weight: float) -> dict[str, Tensor]:
    policy.zero_grad()
    policy.config.trained_batches = 0  # which all that is random in a batch follows from
    policy.config.board_loss_weight = weight
    policy.train()(batch)[0].backward()
    return {name: p.grad.clone() for name, p in policy.named_parameters() if p.grad is not None}


def of_vision(name: str) -> bool:
    return bool({*VISION} & {*name.split(".")})


def of_text(name: str) -> bool:
    return bool({*TEXT} & {*name.split(".")})


@pytest.mark.parametrize("frozen", [False, True])
def test_its_gradient_reaches_the_vision_model_unless_that_is_frozen(policy_type: str, frozen: bool) -> None:
    policy = reading_policy(policy_type, freeze_vision_encoder=frozen)
    batch = board_batch(policy)
    less, more = (gradients(policy, batch, weight) for weight in (1.0, 3.0))
    changed = {name for name, grad in more.items() if not torch.allclose(grad, less[name])}
    assert {"board_reader.tokens.weight", "board_reader.read.2.weight"} <= changed
    assert any(map(of_vision, changed)) == (not frozen)
    assert not any(name.startswith(("flow_head", "denoise_head", "pointer", "cell_")) for name in changed)
    assert not any(of_text(name) for name in changed)


def says(policy: Any, logits: list[float]) -> None:
    """Let it read this on every spot, whatever it sees."""
    with torch.no_grad():
        policy.board_reader.read[-1].weight.zero_()
        policy.board_reader.read[-1].bias.copy_(torch.tensor(NUM_SPOTS * logits))


def test_the_loss_is_a_sum_and_accuracy_of_the_stones(policy_type: str) -> None:
    policy = reading_policy(policy_type)
    batch = board_batch(policy)
    says(policy, [0.0, math.log(2), 0.0])  # black, by 1/2
    losses = {}
    for weight in (1.0, 3.0):
        policy.config.board_loss_weight = weight
        for reduction in ("mean", "none"):
            policy.generator.manual_seed(0)
            losses[weight, reduction], metrics = policy(batch, reduction=reduction)
            expected = ((NUM_SPOTS - 3) * math.log(4) + 3 * math.log(2)) / 25
            assert metrics["board_loss"] == pytest.approx(expected)
            assert metrics["board_accuracy"] == pytest.approx(3 / 5)
    for reduction in ("mean", "none"):
        added = losses[3.0, reduction] - losses[1.0, reduction]
        torch.testing.assert_close(added, torch.full_like(added, 2 * expected), atol=1e-4, rtol=0)
    assert losses[1.0, "none"].shape == (4,)


def test_where_a_token_lies_tells() -> None:
    torch.manual_seed(0)
    reader, features = BoardReader(8, 16), torch.randn(2, 8, 16)
    assert reader(features).shape == (2, NUM_SPOTS, 3)
    assert not torch.allclose(reader(features), reader(features.flip(1)))


@pytest.mark.parametrize(("num_tokens", "hidden_size"), [(8, 128), (128, 2048), (512, 2304), (3072, 960)])
def test_it_is_small_with_any_backbone(num_tokens: int, hidden_size: int) -> None:
    """Nano, Qwen2.5-VL, PaliGemma 2, and a dozen images."""
    with torch.device("meta"):
        reader = BoardReader(num_tokens, hidden_size)
    assert sum(parameter.numel() for parameter in reader.parameters()) < max(700_000, 1100 * num_tokens)


def test_without_pointing_or_weight_there_is_none(policy_type: str) -> None:
    plain = CASES[policy_type].make_policy()
    assert plain.config.board_loss_weight == 1 and plain.board_reader is None
    policy = reading_policy(policy_type, board_loss_weight=0.0)
    assert policy.board_reader is None
    assert not any("board" in name for each in (plain, policy) for name in each.state_dict())
    batch = board_batch(policy)
    del batch[SPOTS]
    assert "board_loss" not in policy(batch)[1]
    plain_losses = []
    for weight in (0.0, 1.0):
        plain.config.board_loss_weight, plain.config.trained_batches = weight, 0
        plain_losses.append(plain.train()(CASES[policy_type].make_batch(plain, 2))[0])
    assert torch.equal(*plain_losses)


def test_labels_are_of_training_only(policy_type: str) -> None:
    policy = reading_policy(policy_type)
    batch = board_batch(policy)
    del batch[SPOTS]
    policy.predict_action_chunk(batch)
    with pytest.raises(KeyError, match=rf"{policy_type} needs 'observation\.pointing\.spots'"):
        policy(batch)


def test_it_learns_to_read_a_board() -> None:
    policy = reading_policy("fdvla", draws_per_chunk=1, freeze_vision_encoder=False)
    batch = board_batch(policy)
    optimizer, metrics = torch.optim.AdamW(policy.get_optim_params(), lr=2e-3, weight_decay=0.0), {}
    for _ in range(100):
        loss, metrics = policy.train()(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if metrics["board_loss"] < 0.02:
            break
    assert metrics["board_loss"] < 0.02 and metrics["board_accuracy"] == 1
    # off the images: another row's are another row's board
    images = {key: batch[key].roll(1, dims=0) for key in batch if key.startswith("observation.images.")}
    moved = policy(batch | images | {SPOTS: batch[SPOTS].roll(1, dims=0)})[1]
    assert moved["board_accuracy"] == 1
    assert policy(batch | images)[1]["board_accuracy"] < 0.9


# Labels


def test_a_stone_counts_that_lies_on_an_intersection() -> None:
    env: Any = make_env(EpisodeSpec(0), SMALL).unwrapped
    env.reset(seed=3)
    state = env.privileged_state()
    env.close()
    lies_m, xyz = state.stone_xyz[0, 2], state.stone_xyz.copy()
    xyz[:7] = [
        [-0.090, 0.090, lies_m],  # black, far left corner
        [0.045, 0.007, lies_m],  # white, 7 mm beside (2, 3)
        [0.090, -0.081, lies_m],  # 9 mm beside the near right corner
        [0.000, 0.000, lies_m + 0.011],  # lifted
        [-0.045, 0.000, lies_m],  # not in play
        [0.170, 0.000, lies_m],  # in the tray
        [0.146, 0.051, lies_m],  # its far left corner: 6 mm from a spot in x and in y
    ]
    state = replace(
        state,
        stone_xyz=xyz,
        stone_is_white=np.arange(len(xyz)) == 1,
        stone_in_play=np.isin(np.arange(len(xyz)), [0, 1, 2, 3, 5, 6]),
    )
    expected = np.zeros((5, 5), int)
    expected[0, 0], expected[2, 3] = 1, 2
    read = colors_on_spots(state)
    np.testing.assert_array_equal(read[:25].reshape(5, 5), expected)
    assert [SPOTS_XY_M[25 + i] for i in np.flatnonzero(read[25:])] == [(0.140, 0.045), (0.170, 0.0)]
    assert read[25:].max() == read[25:].sum() / 2 == 1
    column = Pointing.of(state, np.random.default_rng(0)).columns()["pointing.spots"]
    assert column.dtype == np.float32 and column.tolist() == read.tolist()
    nothing = replace(state, stone_in_play=np.zeros(len(xyz), bool))
    np.testing.assert_array_equal(colors_on_spots(nothing), np.zeros(NUM_SPOTS))


@pytest.mark.parametrize("suite", ["spatial", "goal"])
def test_the_board_of_an_opening_is_read(suite: str) -> None:
    spec = EpisodeSpec(4, suite)
    env: Any = make_env(spec, SMALL).unwrapped
    observation, _ = env.reset(seed=4)
    env.close()
    opening = find_suite(suite).sample(spec).opening
    expected = np.zeros((5, 5), int)
    for intersection, color in opening.items():
        expected[intersection] = {"black": 1, "white": 2}[color]
    read = colors_on_spots(PrivilegedState.from_vector(observation["environment_state"]))
    assert opening and read[:25].reshape(5, 5).tolist() == expected.tolist()


# Checkpoints and data


def load(policy: Any, folder: Path, **flags: Any) -> Any:
    overrides = [f"--{name}={value}" for name, value in flags.items()]
    config: Any = PreTrainedConfig.from_pretrained(folder, cli_overrides=overrides)
    return type(policy).from_pretrained(folder, config=config)


def test_a_training_goes_on_from_a_checkpoint(policy_type: str, tmp_path: Path) -> None:
    policy = reading_policy(policy_type)
    batch = board_batch(policy)
    optimizer = torch.optim.SGD(policy.get_optim_params(), lr=0.1)
    policy.train()(batch)[0].backward()
    optimizer.step()
    policy.save_pretrained(tmp_path)
    again, trained_batches = load(policy, tmp_path), policy.config.trained_batches
    answers = []
    for each in (policy, again):
        each.config.trained_batches = trained_batches
        answers.append(each.train()(batch))
    assert torch.equal(answers[0][0], answers[1][0]) and answers[0][1] == answers[1][1]


def test_checkpoints_do_with_and_without(policy_type: str, tmp_path: Path) -> None:
    policy = reading_policy(policy_type)
    batch = CASES[policy_type].make_batch(policy, 2)
    policy.save_pretrained(tmp_path / "with")
    less = load(policy, tmp_path / "with", board_loss_weight=0.0)
    less.save_pretrained(tmp_path / "without")
    more = load(policy, tmp_path / "without", board_loss_weight=0.5)
    assert less.board_reader is None and isinstance(more.board_reader, BoardReader)
    answers = [each.eval().predict_action_chunk(batch) for each in (policy, less, more)]
    assert torch.equal(answers[0], answers[1]) and torch.equal(answers[0], answers[2])


def test_adapters_train_it_whole(policy_type: str) -> None:
    pytest.importorskip("peft")
    policy = reading_policy(policy_type, dtype="float32")
    policy.config.pretrained_path = Path("base")
    wrapped = policy.wrap_with_peft(peft_cli_overrides={"method_type": "LORA", "r": 4})
    loss, metrics = wrapped.train()(board_batch(policy))
    loss.backward()
    found = {
        name: parameter.grad for name, parameter in wrapped.named_parameters() if ".board_reader." in name
    }
    trained = [grad for name, grad in found.items() if "modules_to_save" in name]
    assert len(trained) == 6 and all(grad is not None and grad.any() for grad in trained)
    assert metrics["board_loss"] > 0


def test_a_dataset_without_boards_is_refused(policy_type: str, tmp_path: Path) -> None:
    meta = make_dataset(tmp_path / "data", spatialvla_grid_pointing_cases.PLACES)
    policy_class, cases = type(CASES[policy_type].make_policy()), POINTING[policy_type]
    options = {**cases.POINTING, "board_loss_weight": 1.0, "pointing_range_m": 3.0}
    if policy_type != "vla0_smol":
        del options["pointing_range_m"]
    config = CASES[policy_type].make_config(**options)
    with pytest.raises(
        ValueError,
        match=r"--policy\.pointing=true is trained on the columns observation\.pointing\.spots, which "
        r"test/pointing lacks; lerobot-bomb record --pointing writes them; --policy\.board_loss_weight=0",
    ):
        policy_class(config, dataset_meta=meta)
    config.board_loss_weight = 0.0
    assert policy_class(config, dataset_meta=meta).board_reader is None


def test_a_wrong_weight_is_named(policy_type: str) -> None:
    options = {**POINTING[policy_type].POINTING, "board_loss_weight": -1.0}
    with pytest.raises(FlagError, match=r"--policy\.board_loss_weight=-1\.0 must not be negative"):
        CASES[policy_type].make_config(**options)
