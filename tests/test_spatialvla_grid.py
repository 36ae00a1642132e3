"""The policy `spatialvla_grid` on the nano backbone."""

import copy
from pathlib import Path
from typing import Any

import pandas
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import make_pre_post_processors
from relative_cases import make_dataset
from spatialvla_grid_cases import SIZE, WORKSPACE, WRIST, make_batch, make_config, make_policy, stats
from torch import Tensor, nn
from torch.nn.functional import cosine_similarity, cross_entropy

from lerobot_bomb.flag_errors import FlagError
from lerobot_policy_bomb.spatialvla_grid.modeling_spatialvla_grid import SpatialvlaGridPolicy

PLAIN: dict[str, Any] = {"crop_fraction": 1.0}
BEFORE = Path(__file__).parent / "fixtures" / "before_layout" / "spatialvla_grid"


def learn(policy: SpatialvlaGridPolicy, batch: dict[str, Any], max_steps: int = 200) -> None:
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=1e-3, weight_decay=0.0)
    for _ in range(max_steps):
        policy.train()
        loss, metrics = policy(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if metrics["token_accuracy"] == 1 and loss < 0.05:
            return
    pytest.fail(f"not learned by heart in {max_steps} steps; loss {float(loss)}")


def with_depth(policy: SpatialvlaGridPolicy, batch: dict[str, Any], seed: int = 0) -> dict[str, Any]:
    generator = torch.Generator().manual_seed(seed)
    size = len(batch["task"]), SIZE, SIZE
    camera = torch.tensor([[80.0, 0, 31.5], [0, 80, 31.5], [0, 0, 1]])
    for key in policy._cameras:
        name = key.removeprefix("observation.images.")
        batch[f"observation.depth.{name}"] = 0.5 + torch.rand(size, generator=generator)
        batch[f"observation.intrinsics.{name}"] = camera.expand(size[0], 3, 3)
    return batch


# Learning


@pytest.mark.parametrize(
    ("num_dims", "options"),
    [
        (4, {}),
        pytest.param(7, {"use_state": True, "prefix_attention": "causal"}, marks=pytest.mark.long),
        pytest.param(2, {"loss_vocab": "full"}, marks=pytest.mark.long),
        pytest.param(14, {"chunk_size": 2, "n_action_steps": 2, "dtype": "bfloat16"}, marks=pytest.mark.long),
        (4, {"depth_source": "observation"}),
    ],
)
def test_chunks_are_learned_by_heart(num_dims: int, options: dict[str, Any]) -> None:
    policy = make_policy(num_dims=num_dims, **PLAIN, **options)
    batch = with_depth(policy, make_batch(policy, 3))
    learn(policy, batch)
    expected = policy.grids.decode(policy.grids.encode(batch["action"]))
    assert torch.equal(policy.predict_action_chunk(batch), expected)


def test_the_loss_is_the_likelihood_among_a_slots_cells() -> None:
    policy = make_policy(num_dims=7, **PLAIN)
    batch = make_batch(policy, 2)
    loss, _ = policy(batch)
    cells_BTG = policy.grids.encode(batch["action"])
    hidden = policy._hidden(batch, cells_BTG.flatten(1))[0].unflatten(1, cells_BTG.shape[1:])
    logits = policy.backbone.cap(policy.cell_head(hidden))
    expected = torch.stack(
        [
            cross_entropy(
                logits[:, :, group, first : first + num].flatten(0, 1), cells_BTG[..., group].flatten()
            )
            for group, (first, num) in enumerate(
                zip(policy.grids.offsets, policy.grids.num_cells, strict=True)
            )
        ]
    ).mean()
    torch.testing.assert_close(loss, expected)
    policy.config.loss_vocab = "full"
    words = policy.backbone.vlm.lm_head(hidden)
    whole = torch.cat([logits, policy.backbone.cap(words)], dim=-1).flatten(0, 2)
    labels = (cells_BTG + torch.tensor(policy.grids.offsets)).flatten()
    torch.testing.assert_close(policy(batch)[0], cross_entropy(whole, labels))


def test_padded_steps_carry_neither_loss_nor_gradient() -> None:
    policy = make_policy(**PLAIN)
    batch = make_batch(policy, 2)
    batch["action_is_pad"] = torch.tensor([[False, False, True, True], [False] * 4])
    changed = {**batch, "action": batch["action"].clone()}
    changed["action"][0, 2:] *= -1
    results = []
    for each in (batch, changed):
        policy.zero_grad()
        loss, metrics = policy(each)
        loss.backward()
        gradients = [p.grad.clone() for p in policy.parameters() if p.grad is not None]
        results.append((loss, metrics, gradients))
    (loss, metrics, gradients), (other, other_metrics, other_gradients) = results
    # later cells are read by nothing that counts
    torch.testing.assert_close(loss, other, rtol=0, atol=1e-6)
    assert metrics == other_metrics
    for one, another in zip(gradients, other_gradients, strict=True):
        torch.testing.assert_close(one, another, rtol=1e-4, atol=1e-6)
    policy.config.loss_on_padded_actions = True
    assert not torch.isclose(policy(batch)[0], policy(changed)[0])


def test_one_loss_a_sample_when_asked() -> None:
    policy = make_policy(**PLAIN)
    batch = make_batch(policy, 3)
    losses, _ = policy(batch, reduction="none")
    assert losses.shape == (3,)
    torch.testing.assert_close(losses.mean(), policy(batch)[0])
    with pytest.raises(ValueError, match="reduction='sum' is unknown; choose mean or none"):
        policy(batch, reduction="sum")


def test_words_embeddings_are_frozen_and_cells_are_trained() -> None:
    policy = make_policy()
    assert not policy.backbone.vlm.get_input_embeddings().weight.requires_grad
    policy(make_batch(policy, 2))[0].backward()
    for table in (policy.cell_embedding.weight, policy.cell_head.weight):
        assert table.grad is not None and table.grad.abs().sum() > 0
    assert make_policy(freeze_llm_embeddings=False).backbone.vlm.get_input_embeddings().weight.requires_grad


def test_cells_are_embedded_at_the_scale_of_words() -> None:
    """transformers 5 multiplies by sqrt(H) inside `embed_tokens`."""
    policy = make_policy()
    words: Any = policy.backbone.vlm.get_input_embeddings()
    with torch.no_grad():
        policy.cell_embedding.weight[7] = words.weight[42]
    cell, word = policy._embed_cells(torch.tensor([7])), policy.backbone.embed_tokens(torch.tensor([42]))
    torch.testing.assert_close(cell, word)
    torch.testing.assert_close(word[0].norm(), 128**0.5 * words.weight[42].norm())


def saved_bytes(loss_vocab: str) -> int:
    """Return the bytes that the loss keeps for its backward pass, at PaliGemma 2's vocabulary."""
    policy = make_policy(num_dims=7, loss_vocab=loss_vocab)
    hidden_size = 8
    policy.backbone.vlm.lm_head = nn.Linear(hidden_size, 257_152, bias=False)
    policy.cell_head = nn.Linear(hidden_size, policy.grids.num_tokens, bias=False)
    hidden_BSH = torch.randn(8, 4 * 3, hidden_size, requires_grad=True)
    cells_BTG = policy.grids.encode(torch.rand(8, 4, 7) * 2 - 1)
    kept: dict[int, int] = {}

    def keep(tensor: Tensor) -> Tensor:
        if not isinstance(tensor, nn.Parameter):
            kept[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        policy._losses(hidden_BSH, cells_BTG.flatten(1))[0].mean().backward()
    return sum(kept.values())


def test_a_slots_loss_keeps_less_than_a_quarter_of_the_full_ones() -> None:
    assert saved_bytes("slot") < saved_bytes("full") / 4


# Depth


def test_depth_changes_nothing_before_training_and_something_after() -> None:
    policy, blind = make_policy(**PLAIN, depth_source="observation"), make_policy(**PLAIN)
    batch = with_depth(policy, make_batch(policy, 2))
    assert torch.equal(policy(batch)[0], blind(batch)[0])
    learn(policy, batch)
    trained = policy(batch)[0]
    assert not torch.isclose(policy(with_depth(policy, dict(batch), seed=1))[0], trained, rtol=1e-6)


def test_depth_stays_in_metres(tmp_path: Path) -> None:
    """LeRobot has statistics of each column of floats, in new processors and in those of a checkpoint."""
    policy = make_policy(depth_source="observation")
    depth = {f"observation.depth.{name}": torch.full((1, SIZE, SIZE), 0.8) for name in ("workspace", "wrist")}
    of_depth = {"min": torch.full((1, 1, 1), 0.1), "max": torch.full((1, 1, 1), 1.5)}
    statistics = stats() | dict.fromkeys(depth, of_depth)
    processors = make_pre_post_processors(policy.config, dataset_stats=statistics)
    for part in (policy, *processors):
        part.save_pretrained(tmp_path)
    config: Any = PreTrainedConfig.from_pretrained(tmp_path)
    loaded = SpatialvlaGridPolicy.from_pretrained(tmp_path, config=config)
    overrides = {"normalizer_processor": {"stats": statistics}}
    again = make_pre_post_processors(config, pretrained_path=str(tmp_path), preprocessor_overrides=overrides)
    assert loaded.config is config
    for preprocess, _ in (processors, again):
        batch = preprocess({**depth, "observation.state": torch.zeros(1, 4), "task": ["go"]})
        assert all(batch[key].equal(values) for key, values in depth.items())


def test_depth_follows_the_crop(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pixel's depth and place in the camera's frame stay with what is seen there."""
    policy = make_policy(depth_source="observation", crop_fraction=0.5)
    batch = make_batch(policy, 1)
    with_depth(policy, batch)
    rows = torch.arange(SIZE).float()
    batch["observation.depth.workspace"] = (1 + rows[:, None] + rows / 100).expand(1, -1, -1).contiguous()
    seen: list[Tensor] = []
    policy.ego3d.register_forward_pre_hook(lambda _, args: seen.append(args[0]))
    policy.train()
    policy(batch)
    points = seen[0][0]
    depth, width = points[..., 2], SIZE / 2 / policy.ego3d.lattice_size
    # the depth says which line and column of the whole image a point was read from
    lines, columns = depth.long() - 1, ((depth % 1) * 100).round()
    assert torch.equal(lines[1:, 0] - lines[:-1, 0], torch.full((15,), int(2 * width / 2)))
    x_of_pixel = (columns - 31.5) / 80 * depth
    assert ((points[..., 0] - x_of_pixel).abs() <= (0.5 * width + 0.5) / 80 * depth).all()


# Inference


def test_actions_are_queued_and_forgotten_on_reset() -> None:
    policy = make_policy(n_action_steps=2)
    first, second = make_batch(policy, 2, seed=1), make_batch(policy, 2, seed=2)
    chunks = [policy.predict_action_chunk(batch) for batch in (first, second)]
    assert not torch.equal(chunks[0][:, :2], chunks[1][:, :2])
    assert torch.equal(policy.select_action(first), chunks[0][:, 0])
    assert torch.equal(policy.select_action(second), chunks[0][:, 1])  # still of the first prediction
    assert torch.equal(policy.select_action(second), chunks[1][:, 0])
    policy.reset()
    assert torch.equal(policy.select_action(first), chunks[0][:, 0])


def test_dropped_actions_are_not_averaged_either() -> None:
    policy = make_policy(n_action_steps=1, temporal_ensemble_size=2)
    first, second = make_batch(policy, 1, seed=1), make_batch(policy, 1, seed=2)
    chunks = [policy.predict_action_chunk(batch) for batch in (first, second)]
    policy.reset()
    policy.select_action(first)
    policy.drop_queued_actions()
    torch.testing.assert_close(policy.select_action(second), chunks[1][:, 0])


def test_an_ensemble_weighs_by_agreement_but_for_the_gripper() -> None:
    """Check the weights of the original's evaluations: exp(0.1 times the cosine with the newest action)."""
    options: dict[str, Any] = {"n_action_steps": 1, "temporal_ensemble_size": 2}
    policy = make_policy(num_dims=7, **options)
    first, second = make_batch(policy, 1, seed=1), make_batch(policy, 1, seed=2)
    chunks = [policy.predict_action_chunk(batch) for batch in (first, second)]
    policy.reset()
    policy.select_action(first)
    action = policy.select_action(second)
    newest, older = chunks[1][:, 0], chunks[0][:, 1]
    weights = torch.tensor([0.1, 0.1 * cosine_similarity(newest, older).item()]).softmax(dim=0)
    torch.testing.assert_close(action[:, :6], (weights[0] * newest + weights[1] * older)[:, :6])
    assert torch.equal(action[:, 6], newest[:, 6])


def test_a_checkpoint_of_before_keeps_the_weights_of_its_ensemble() -> None:
    overrides = ["--temporal_ensemble_size=2", "--n_action_steps=1"]
    config: Any = PreTrainedConfig.from_pretrained(BEFORE, cli_overrides=overrides)
    assert (config.temporal_ensemble_weighting, config.temporal_ensemble_coefficient) == ("uniform", 0.01)
    ensemble = SpatialvlaGridPolicy.from_pretrained(BEFORE, config=config)._ensemble
    assert ensemble is not None
    ensemble(torch.tensor([[[9.0] * 4, [1.0] * 4]]))
    # its gripper is open or closed
    assert ensemble(torch.tensor([[[-0.5] * 4, [9.0] * 4]])).tolist() == [[0.25, 0.25, 0.25, -0.5]]


def test_dimensions_that_are_named_are_not_averaged() -> None:
    names = ["x", "y", "z", "gripper"]
    options = {"n_action_steps": 1, "temporal_ensemble_size": 2, "action_feature_names": names}
    policy = make_policy(temporal_ensemble_exclude_joints=["gripper", "y"], **options)
    assert policy._newest_only() == [1, 3]


def test_training_goes_on_after_evaluation_inside_one_autocast() -> None:
    policy = make_policy(dtype="bfloat16")
    batch = make_batch(policy, 2)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        with torch.inference_mode():
            policy.select_action(batch)
        loss, _ = policy.train()(batch)
        loss.backward()
    assert policy.cell_head.weight.grad is not None


# Bad input


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"chunk_size": 0}, "--policy.chunk_size=0 must be at least 1"),
        ({"n_action_steps": 5}, "--policy.n_action_steps=5 must lie in 1..4"),
        ({"grid_distribution": "normal"}, "--policy.grid_distribution"),
        ({"decode_point": "median"}, "--policy.decode_point"),
        ({"depth_source": "lidar"}, "--policy.depth_source"),
        ({"loss_vocab": "all"}, "--policy.loss_vocab"),
        ({"crop_fraction": 0.0}, r"--policy.crop_fraction=0.0 must lie in \(0, 1\]"),
        ({"temporal_ensemble_size": 2}, "needs --policy.n_action_steps=1; got 4"),
        ({"use_amp": True}, "--policy.dtype=bfloat16 instead"),
        ({"ego3d_patch_reso": 0}, "--policy.ego3d_patch_reso=0 must be at least 1"),
        (
            {"action_groups": [{"dims": [0, 1], "transform": "identity", "bins": [8, 8]}]},
            "--policy.action_groups: the groups have the dims",
        ),
        ({"action_groups": [{"dims": [0]}]}, "must have exactly the keys"),
    ],
)
def test_wrong_flags_are_told(options: dict[str, Any], message: str) -> None:
    with pytest.raises((FlagError, ValueError), match=message):
        make_config(**options)


def test_depth_that_is_asked_for_must_be_there() -> None:
    """A dataset's features tell before any training, a batch's keys later."""
    message = r"needs observation\.depth\.\w+, .*Record and evaluate with --env\.depth=true"
    with pytest.raises(ValueError, match=message):
        make_policy(depth_source="observation", has_depth=False)
    with pytest.raises(ValueError, match=r"needs observation\.depth\.\w+, observation\.depth\.\w+;"):
        square = [[80.0, 0, 32], [0, 80, 32], [0, 0, 1]]
        intrinsics = {"workspace": square, "wrist": square}
        make_policy(depth_source="observation", has_depth=False, camera_intrinsics=intrinsics)
    policy = make_policy(depth_source="observation")
    with pytest.raises(KeyError, match=r"observation\.depth\.\w+'; .*Record and evaluate with --env\.depth"):
        policy(make_batch(policy, 2))


def test_a_batch_without_a_camera_is_told() -> None:
    policy = make_policy()
    batch = make_batch(policy, 2)
    del batch[WORKSPACE]
    with pytest.raises(KeyError, match=f"spatialvla_grid needs '{WORKSPACE}'"):
        policy(batch)


def test_actions_of_another_shape_are_told() -> None:
    policy = make_policy()
    batch = make_batch(policy, 2)
    batch["action"] = batch["action"][:, :2]
    with pytest.raises(ValueError, match=r"expected \(batch, 4, 4\)"):
        policy(batch)


def test_a_copy_of_the_policy_acts_alike() -> None:
    policy = make_policy()
    batch = make_batch(policy, 2)
    assert torch.equal(copy.deepcopy(policy).predict_action_chunk(batch), policy.predict_action_chunk(batch))


@pytest.mark.parametrize("tasks", [["", ""], ["", "go"]])
def test_an_environment_may_name_no_task(tasks: list[str]) -> None:
    """Check the empty text, which PushT gives."""
    policy = make_policy()
    preprocessor, _ = make_pre_post_processors(policy.config, dataset_stats=stats())
    batch = make_batch(policy, 2)
    shown = {key: batch[key] for key in (WORKSPACE, WRIST, "observation.state", "action")}
    batch = preprocessor({**shown, "task": tasks})
    num_tokens = policy.prompt(batch).mask.sum(dim=1)
    assert (num_tokens > num_tokens.min()).tolist() == [False, tasks[1] == "go"]
    assert policy(batch)[0].isfinite()
    assert policy.predict_action_chunk(batch).shape == (2, 4, 4)


def test_an_instruction_beyond_the_positions_is_refused_before_training(tmp_path: Path) -> None:
    meta = make_dataset(tmp_path / "data", 0.1)
    SpatialvlaGridPolicy(make_config(), meta)
    meta.tasks = pandas.DataFrame({"task_index": [0]}, index=pandas.Index(["put the " * 2100]))
    with pytest.raises(ValueError, match="model has 4096 positions; shorten the dataset's instruction 'put"):
        SpatialvlaGridPolicy(make_config(), meta)
