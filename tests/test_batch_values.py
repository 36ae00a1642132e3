"""Batches: whole numbers, truth values, one dimension; images in [0, 1]; a text a row."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.policies.factory import make_policy, make_pre_post_processors
from policy_cases import CASES, save_checkpoint
from safetensors.torch import load_file, save_file
from small_datasets import write_dataset
from torch import Tensor
from torch.utils.data import DataLoader

from lerobot_bomb.data.columns import read_columns

WRIST, STATE, ACTION = "observation.images.wrist", "observation.state", "action"
NUM_FRAMES = 6
KINDS = [("int64", 2), ("bool", 2), ("float32", 1), ("int64", 1)]
RANGES = [(lambda x: 255 * x, "from 0 to 255"), (lambda x: 2 * x - 1, "from -1 to 1")]


@pytest.fixture(scope="module", params=KINDS, ids=lambda kind: f"{kind[0]}-{kind[1]}")
def dataset(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Write two episodes; actions 0 and 1 of a type, states 0.1, 0.2, ..."""
    dtype, num_dims = request.param

    def numbers(frame: int) -> tuple[np.ndarray, np.ndarray]:
        state = np.full(num_dims, 0.1 * (frame + 1), dtype=np.float32)
        return state, ((np.arange(num_dims) + frame) % 2).astype(dtype)

    return write_dataset(tmp_path_factory.mktemp("batch_values") / "values", numbers, num_frames=NUM_FRAMES)


def policy_for(dataset: LeRobotDataset, policy_type: str, **options: Any) -> Any:
    config = CASES[policy_type].make_config(**options)
    config.input_features = {}  # the dataset's, as lerobot-train has them
    return make_policy(config, ds_meta=dataset.meta)


def first_batch(dataset: LeRobotDataset, chunk_size: int) -> dict[str, Any]:
    """Read a batch as LeRobot does; a chunk of 1 is the frame's own action."""
    steps = [step / dataset.fps for step in range(chunk_size)]
    timestamps = {ACTION: steps} if chunk_size > 1 else None
    chunked = LeRobotDataset(dataset.repo_id, root=dataset.root, delta_timestamps=timestamps)
    return next(iter(DataLoader(chunked, batch_size=3)))


@pytest.mark.parametrize("chunk_size", [1, 2])
def test_whole_numbers_and_one_dimension_train_and_act(
    dataset: LeRobotDataset, policy_type: str, chunk_size: int, tmp_path: Path
) -> None:
    options = {"crop_fraction": 1.0, "use_state": True, "chunk_size": chunk_size, "n_action_steps": 1}
    options |= {"mask_max_fraction": 0.0} if policy_type == "vla0_smol" else {}
    policy = policy_for(dataset, policy_type, **options)
    stats: Any = dataset.meta.stats
    preprocess, postprocess = make_pre_post_processors(policy.config, dataset_stats=stats)
    raw = first_batch(dataset, chunk_size)
    batch = preprocess(dict(raw))

    num_dims = policy.config.action_feature.shape[0]
    read = read_columns(dataset.meta, (ACTION, STATE))
    taken = np.minimum(np.arange(3)[:, None] + np.arange(chunk_size), NUM_FRAMES - 1)
    for key, rows in ((STATE, read[STATE][:3]), (ACTION, read[ACTION][taken])):
        low, high = (stats[key][name] for name in ("min", "max"))
        expected = 2 * (rows - low) / (high - low) - 1
        if policy_type == "fdvla":
            expected = (rows - stats[key]["mean"]) / stats[key]["std"]
        assert batch[key].dtype == torch.float32
        np.testing.assert_allclose(batch[key].reshape(expected.shape), expected, rtol=1e-4, atol=1e-5)
    assert tuple(batch[STATE].shape) == (3, num_dims)

    loss, _ = policy.train()(batch)
    loss.backward()
    assert 0 < float(loss.detach()) < 100
    policy.reset()
    observation = {key: values for key, values in raw.items() if not key.startswith(ACTION)}
    action = postprocess(policy.select_action(preprocess(observation)))
    assert tuple(action.shape) == (3, num_dims) and action.isfinite().all()

    preprocess.save_pretrained(tmp_path)
    (file,) = tmp_path.glob("*normalizer*.safetensors")
    saved = load_file(file)
    assert {tensor.dtype for tensor in saved.values()} == {torch.float32}
    np.testing.assert_allclose(saved[f"{STATE}.max"], np.full(num_dims, 0.6), rtol=1e-6)


@pytest.mark.parametrize("dtype", ["int64", "bool"])
def test_relative_actions_of_whole_numbers(dtype: str, tmp_path: Path) -> None:
    """Check that what is fitted has fractions: a state of 0 and 1, and an action that is the next one."""

    def numbers(frame: int) -> tuple[np.ndarray, np.ndarray]:
        now, after = (np.array([step % 6 > 2]).astype(dtype) for step in (frame, frame + 1))
        return now, after

    dataset = write_dataset(tmp_path / "toggle", numbers)
    policy = policy_for(dataset, "fdvla", relative_actions=True, chunk_size=1, n_action_steps=1)
    preprocess, _ = make_pre_post_processors(policy.config, dataset_stats=dataset.meta.stats)  # pyright: ignore
    loss, _ = policy(preprocess(first_batch(dataset, 1)))
    assert float(loss.detach()) < 100


def test_statistics_that_were_rounded_are_refused(policy_type: str, tmp_path: Path) -> None:
    policy = save_checkpoint(policy_type, tmp_path)
    make_pre_post_processors(policy.config, str(tmp_path))
    (file,) = tmp_path.glob("*_normalizer*.safetensors")
    save_file({name: values.long() for name, values in load_file(file).items()}, file)
    message = rf"{file}: \S+ is torch.int64, not a float: the checkpoint was trained on whole numbers"
    with pytest.raises(ValueError, match=message):
        type(policy).from_pretrained(tmp_path)
    with pytest.raises(ValueError, match=message):  # as LeRobot's commands do
        make_pre_post_processors(policy.config, str(tmp_path))


@pytest.fixture(scope="module")
def preprocessors() -> dict[str, Any]:
    made = {}
    for name, cases in CASES.items():
        stats = cases.STATS if name == "vla0_smol" else cases.stats()
        made[name] = make_pre_post_processors(cases.make_config(), dataset_stats=stats)[0]
    return made


def raw_batch() -> dict[str, Any]:
    image = torch.linspace(0, 1, 3 * 64 * 64).view(1, 3, 64, 64).repeat(2, 1, 1, 1)
    return {
        WRIST: image,
        "observation.images.workspace": image.clone(),
        "observation.images.depth": torch.full((2, 1, 64, 64), 3.0),  # metres, as LeRobot 0.6 names it
        STATE: torch.zeros(2, 4),
        "task": ["go", "stay"],
        "index": torch.tensor([40, 51]),
        "episode_index": torch.tensor([3, 4]),
    }


@pytest.mark.parametrize(("change", "found"), RANGES)
def test_images_of_another_range_are_refused(
    preprocessors: dict[str, Any], policy_type: str, change: Any, found: str
) -> None:
    raw = raw_batch()
    preprocessors[policy_type](dict(raw))
    raw[WRIST][1] = change(raw[WRIST][1])
    with pytest.raises(
        ValueError, match=rf"'{WRIST}' has values {found}, .* in frame 51 .*, of episode 4, row 1"
    ):
        preprocessors[policy_type](raw)


@pytest.mark.parametrize(("change", "found"), RANGES)
def test_a_policy_alone_refuses_such_images(policy_type: str, change: Any, found: str) -> None:
    policy = CASES[policy_type].make_policy()
    batch = CASES[policy_type].make_batch(policy, 2)
    ends: Tensor = batch[WRIST]
    ends[1].view(-1)[:2] = torch.tensor([0.0, 1.0])
    batch[WRIST] = torch.stack([ends[0], change(ends[1])])
    for act in (policy, policy.select_action):
        with pytest.raises(
            ValueError, match=rf"'{WRIST}' has values {found}, the first such image in row 1 of"
        ):
            act(batch)


def test_rounding_is_no_other_range(preprocessors: dict[str, Any]) -> None:
    raw = raw_batch()
    raw[WRIST] = raw[WRIST] * (1 + 1e-4) - 1e-5
    preprocessors["fdvla"](raw)


def test_a_text_for_each_row(preprocessors: dict[str, Any], policy_type: str) -> None:
    for task in ("go", ["go"], ["go", "go", "go"]):
        num = 1 if isinstance(task, str) else len(task)
        with pytest.raises(ValueError, match=rf"2 rows of '{WRIST}' and {num} instructions under 'task'"):
            preprocessors[policy_type]({**raw_batch(), "task": task})


def test_a_state_of_another_size_is_named(policy_type: str) -> None:
    policy = CASES[policy_type].make_policy(use_state=True)
    batch = CASES[policy_type].make_batch(policy, 2)
    batch[STATE] = batch[STATE][:, :3]
    with pytest.raises(ValueError, match=rf"batch\['{STATE}'\] has shape \(2, 3\); expected \(batch, 4\)"):
        policy.select_action(batch)
