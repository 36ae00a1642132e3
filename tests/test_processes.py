"""Two processes train what one does on their batches together; layers that FSDP shards one by one.

FSDP is not resumed here: on CPUs torch mixes up the optimiser states that it gathers.
"""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.policies.factory import get_policy_class
from lerobot.scripts import lerobot_train
from policy_cases import CASES
from recipes import recipe_path
from torch import distributed
from torch.distributed.device_mesh import init_device_mesh
from torch.distributed.fsdp import fully_shard
from training_processes import NUM_PROCESSES, Seen, Training, draws_by_sample, in_processes, seen_losses
from variants import as_flags, small_policy

REPO_ID = "overfit/bomb_place"  # the recipes'
BATCH_SIZE, NUM_EPISODES, EPISODE_LENGTH = 2, 3, 4
STEPS, SAVE_FREQ = 4, 2  # an epoch is 3 steps long
# nothing is drawn but what `draws_by_sample` makes a function of the sample
FIXED = {
    "fdvla": ["--policy.draws_per_chunk=1"],
    "spatialvla_grid": [],
    "vla0_smol": ["--policy.mask_max_fraction=0"],
}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Episodes that are shorter than a chunk, so that batches are padded differently."""
    root = tmp_path_factory.mktemp("short") / "dataset"
    number = {"dtype": "float32", "shape": (4,), "names": ["x", "y", "z", "finger_opening"]}
    image = {"dtype": "image", "shape": (64, 64, 3), "names": ["height", "width", "channels"]}
    features = {"observation.state": number, "action": number, "observation.images.workspace": image}
    made = LeRobotDataset.create(REPO_ID, fps=10, features=features, root=root, use_videos=False)
    generator = np.random.default_rng(0)
    for episode in range(NUM_EPISODES):
        for _ in range(EPISODE_LENGTH):
            numbers = {name: generator.uniform(-1, 1, 4).astype(np.float32) for name in list(features)[:2]}
            pixels = generator.integers(0, 256, (64, 64, 3), dtype=np.uint8)
            task = "put the stone " + "far " * episode + "away"
            made.add_frame({**numbers, "observation.images.workspace": pixels, "task": task})
        made.save_episode()
    made.finalize()
    return root


def flags(policy_type: str, dataset: Path, batch_size: int, output_dir: str) -> list[str]:
    return [
        f"--config_path={recipe_path('overfit', policy_type)}",
        *as_flags(small_policy(policy_type)),
        f"--dataset.root={dataset}",
        f"--output_dir={output_dir}",
        f"--batch_size={batch_size}",
        f"--steps={STEPS}",
        f"--save_freq={SAVE_FREQ}",
        "--num_workers=0",
        "--policy.crop_fraction=1",
        "--policy.drop_n_last_frames=0",
        *FIXED[policy_type],
    ]


def weights(policy_type: str, output_dir: Path) -> dict[str, torch.Tensor]:
    """Load the weights of the last checkpoint; FSDP's file holds tied weights twice."""
    checkpoint = output_dir / "checkpoints" / "last" / "pretrained_model"
    return get_policy_class(policy_type).from_pretrained(checkpoint).state_dict()


def check_trained_as_one(
    policy_type: str, losses: list[float], folder: Path, stock_cli: Callable[..., None], dataset: Path
) -> None:
    """Check losses and weights against one process with a batch as large as theirs together."""
    with seen_losses() as in_one, draws_by_sample():
        together = BATCH_SIZE * NUM_PROCESSES
        stock_cli("lerobot-train", *flags(policy_type, dataset, together, f"{folder}/one"))
    torch.testing.assert_close(losses, in_one, rtol=1e-5, atol=0)
    ours, theirs = (weights(policy_type, folder / name) for name in ("process0", "one"))
    # steps of Adam went 1e-3 each; it makes some of the sign of a gradient that is nearly 0
    assert max(float((ours[name] - theirs[name]).abs().mean()) for name in ours) < 1e-5


@pytest.fixture(scope="module")
def two(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], tuple[Path, Seen]]:
    """Train a policy in two processes, and again from its first checkpoint; return folder and `Seen`."""

    @cache
    def train(policy_type: str) -> tuple[Path, Seen]:
        folder = tmp_path_factory.mktemp("two")
        checkpoint = folder / "process0" / "checkpoints" / f"{SAVE_FREQ:06d}" / "pretrained_model"
        resumed = [f"--config_path={checkpoint}/train_config.json", "--resume=true"]
        trainings = [
            Training(flags(policy_type, dataset, BATCH_SIZE, f"{folder}/process{{rank}}")),
            Training([*resumed, f"--output_dir={folder}/resumed{{rank}}"]),
        ]
        return folder, in_processes(trainings, folder)

    return train


@pytest.mark.long
def test_two_processes_train_what_one_does(
    policy_type: str,
    two: Callable[[str], tuple[Path, Seen]],
    stock_cli: Callable[..., None],
    dataset: Path,
) -> None:
    folder, seen = two(policy_type)
    check_trained_as_one(policy_type, seen.mean_losses(0), folder, stock_cli, dataset)
    theirs, others = (losses[0] for losses in seen.losses)
    assert all(abs(a - b) > 1e-3 for a, b in zip(theirs, others, strict=True))  # of different samples


@pytest.mark.long
def test_going_on_is_exact_and_only_the_first_process_writes(
    policy_type: str, two: Callable[[str], tuple[Path, Seen]]
) -> None:
    folder, seen = two(policy_type)
    for losses in seen.losses:
        assert losses[1] == losses[0][SAVE_FREQ:]
    resumed, whole = (weights(policy_type, folder / name) for name in ("resumed0", "process0"))
    torch.testing.assert_close(resumed, whole, rtol=0, atol=0)
    # LeRobot 0.6.2 makes the folders in every process
    assert not [
        path for name in ("process1", "resumed1") for path in (folder / name).rglob("*") if path.is_file()
    ]


@pytest.mark.long
def test_a_log_line_comes_from_one_process(policy_type: str, two: Callable[[str], tuple[Path, Seen]]) -> None:
    said = {"fdvla": "fdvla: {'backbone'", "spatialvla_grid": f"{REPO_ID}: "}
    if policy_type in said:
        assert two(policy_type)[1].text.count(said[policy_type]) == 2  # in a training and in its resumption


@pytest.mark.long
@pytest.mark.skipif(
    not hasattr(lerobot_train, "gather_fsdp_state_dicts"), reason="LeRobot 0.6.2 has no FSDP1"
)
def test_sharded_by_fsdp_they_train_the_same(
    policy_type: str, stock_cli: Callable[..., None], dataset: Path, tmp_path: Path
) -> None:
    output_dir = str(tmp_path / "process{rank}")
    sharded = Training(flags(policy_type, dataset, BATCH_SIZE, output_dir), is_sharded=True)
    seen = in_processes([sharded], tmp_path)
    check_trained_as_one(policy_type, seen.mean_losses(0), tmp_path, stock_cli, dataset)


def test_fsdp_shards_every_layer_by_itself(policy_type: str) -> None:
    """Check that the repeated blocks of text and vision model are named, and nothing else is repeated."""
    policy = CASES[policy_type].make_policy()
    named = set(policy._no_split_modules)
    assert policy._fsdp_wrap_modules == policy._no_split_modules
    stacks = {
        type(block).__name__
        for module in policy.backbone.modules()
        if isinstance(module, torch.nn.ModuleList)
        for block in module
    }
    assert named == stacks


def test_a_policy_that_is_sharded_in_place_saves_its_weights_whole_and_once(
    policy_type: str, tmp_path: Path
) -> None:
    """Check sharding as of LeRobot 0.6.2; strict loading finds a module's weights that are another's too."""
    policy = CASES[policy_type].make_policy()
    before = {name: tensor.clone() for name, tensor in policy.state_dict().items()}
    distributed.init_process_group("gloo", f"file://{tmp_path}/meeting", rank=0, world_size=1)
    try:
        fully_shard(policy, mesh=init_device_mesh("cpu", (1,)))
        policy.save_pretrained(tmp_path / "saved")
    finally:
        distributed.destroy_process_group()
    after = get_policy_class(policy_type).from_pretrained(tmp_path / "saved").state_dict()
    torch.testing.assert_close(after, before, rtol=0, atol=0)
    named = type(CASES[policy_type].make_policy())._fsdp_wrap_modules  # LeRobot asks the class
    assert named == policy._no_split_modules
