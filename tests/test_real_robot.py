"""LeRobot's commands for robots on an arm without hardware: what it was told is what the policy foresaw."""

import functools
import itertools
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.policies import get_policy_class
from robot_cases import KEYS, Loaded, ScriptedArm, command_at, position_at
from torch import Tensor

from lerobot_bomb.commands.main import main

Run = Callable[..., None]
REPO_ID, TASK = "test/arm", "Pick up the stone."
CHUNK, EXECUTED = 8, 4  # actions of a chunk; of these before the next one
START = 16  # reading at which a rollout begins: far from the ends of the joints' ranges
SMALL = {
    "fdvla": "--policy.image_size=56 --policy.head_dim=32 --policy.dualmod_dim=16",
    "spatialvla_grid": "",
    "vla0_smol": "",
}


@pytest.fixture(autouse=True)
def signals() -> Iterator[None]:
    """lerobot-rollout takes Ctrl-C and its like for itself."""
    taken = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
    usual = {number: signal.getsignal(number) for number in taken}
    yield
    for number, handler in usual.items():
        signal.signal(number, handler)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return where `recorded` puts the dataset."""
    return tmp_path_factory.mktemp("arm") / "dataset"


@pytest.fixture
def recorded(dataset: Path, stock_cli: Run, tmp_path: Path) -> Path:
    """A demonstration by lerobot-record, once for all tests."""
    if not dataset.exists():
        flags = "--dataset.num_episodes=1 --dataset.episode_time_s=2 --dataset.fps=50 --dataset.video=false"
        flags += " --robot.type=scripted_arm --teleop.type=scripted_leader"
        flags += " --dataset.push_to_hub=false --play_sounds=false"
        own = [f"--dataset.repo_id={REPO_ID}", f"--dataset.root={dataset}", f"--dataset.single_task={TASK}"]
        calibration = [f"--{device}.calibration_dir={tmp_path}" for device in ("robot", "teleop")]
        stock_cli("lerobot-record", *flags.split(), *own, *calibration)
    return dataset


@pytest.fixture
def checkpoint(recorded: Path) -> Callable[..., Path]:
    """checkpoint("fdvla", "--policy.NAME=VALUE"): a nano policy with random weights for the arm."""

    def make(policy_type: str, *options: str) -> Path:
        path = recorded.parent / "".join([policy_type, *options])
        flags = f"--policy.type={policy_type} --policy.vlm_model_name=nano --policy.device=cpu"
        flags += f" --policy.chunk_size={CHUNK} --policy.n_action_steps={EXECUTED} --policy.dtype=float32"
        data = [f"--dataset.repo_id={REPO_ID}", f"--dataset.root={recorded}", f"--output={path}"]
        if not path.exists():
            assert (
                main(["checkpoint", "init", *flags.split(), *SMALL[policy_type].split(), *options, *data])
                == 0
            )
        return path

    return make


@pytest.fixture
def rollout(stock_cli: Run, tmp_path: Path) -> Callable[..., ScriptedArm]:
    """rollout(checkpoint, num_actions, flags): the arm after lerobot-rollout."""

    def run(path: Path, num_actions: int, *flags: str) -> ScriptedArm:
        own = f"--robot.type=scripted_arm --robot.start={START} --robot.stop_after={num_actions}"
        own += f" --robot.calibration_dir={tmp_path} --return_to_initial_position=false"
        stock_cli("lerobot-rollout", f"--policy.path={path}", f"--task={TASK}", *own.split(), *flags)
        arm = ScriptedArm.made[-1]
        assert len(arm.told) == num_actions and not arm.is_connected
        return arm

    return run


def told(arm: ScriptedArm) -> Tensor:
    """(T, D) by the motors' names, in the order that the dataset's columns have."""
    return torch.tensor([[action[key] for key in KEYS] for action in arm.told])


def test_lerobot_record_writes_what_the_leader_said_and_the_arm_showed(recorded: Path) -> None:
    dataset = LeRobotDataset(REPO_ID, root=recorded)
    assert dataset.features["action"]["names"] == dataset.features["observation.state"]["names"] == KEYS
    frames = dataset.hf_dataset.with_format("numpy")
    for reading in (0, len(dataset) - 1):
        for column, expected in (
            ("action", command_at(reading)),
            ("observation.state", position_at(reading)),
        ):
            np.testing.assert_allclose(frames[reading][column], list(expected.values()), atol=1e-4)


def foreseen(arm: ScriptedArm, path: Path) -> Tensor:
    """(T, D) that the checkpoint foresees from what the arm showed when a chunk began."""
    loaded, actions = Loaded.of(path), []
    for i in range(0, len(arm.told), EXECUTED):
        seen = arm.shown[arm.num_shown_before[i] - 1]
        chunk = loaded.policy.predict_action_chunk(loaded.batch(seen, TASK))
        actions.append(loaded.physical(chunk)[:EXECUTED])
    return torch.cat(actions)


def test_the_arm_is_told_the_policys_own_chunks(
    policy_type: str, checkpoint: Callable[..., Path], rollout: Callable[..., ScriptedArm]
) -> None:
    path = checkpoint(policy_type)
    arm = rollout(path, 3 * EXECUTED, "--fps=200")
    assert all(action.keys() == set(KEYS) for action in arm.told)
    torch.testing.assert_close(told(arm), foreseen(arm, path), rtol=0, atol=1e-3)


def test_a_relative_chunk_counts_from_where_the_arm_was_when_it_began(
    checkpoint: Callable[..., Path], rollout: Callable[..., ScriptedArm]
) -> None:
    """One image, and no state in the prompt: chunks differ by how far the arm had gone, and in nothing."""
    path = checkpoint("vla0_smol", "--policy.relative_actions=true", "--policy.use_state=false")
    arm = rollout(path, 3 * EXECUTED, "--fps=200")
    torch.testing.assert_close(told(arm), foreseen(arm, path), rtol=0, atol=1e-3)
    chunks = told(arm).view(3, EXECUTED, -1)
    for i in (1, 2):
        began, at_first = (position_at(START + arm.num_shown_before[j] - 1) for j in (i * EXECUTED, 0))
        gone = torch.tensor([began[key] - at_first[key] for key in KEYS])
        assert gone.abs().min() > 0.5  # degrees
        torch.testing.assert_close(chunks[i] - chunks[0], gone.expand(EXECUTED, -1), rtol=0, atol=1e-3)


@dataclass
class Call:
    """Call of predict_action_chunk by real-time chunking."""

    batch: dict[str, Any]
    delay: int
    left_over: Tensor | None  # (K, D) normalised
    chunk: Tensor  # (1, K, D) normalised


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[Call]:
    """Return what LeRobot asks of fdvla, and gets."""
    policy_class: Any = get_policy_class("fdvla")
    usual, made = policy_class.predict_action_chunk, []

    @functools.wraps(usual)
    def predict(self: Any, batch: dict, *args: Any, **options: Any) -> Tensor:
        chunk = usual(self, batch, *args, **options)
        made.append(Call(dict(batch), options["inference_delay"], options["prev_chunk_left_over"], chunk))
        return chunk

    monkeypatch.setattr(policy_class, "predict_action_chunk", predict)
    return made


def test_with_real_time_chunking_each_chunk_goes_on_from_the_last(
    checkpoint: Callable[..., Path],
    rollout: Callable[..., ScriptedArm],
    calls: list[Call],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path = checkpoint("fdvla")
    # the horizon is longer than the chunk, and so is what LeRobot fills up with zeros
    arm = rollout(path, 20, "--fps=10", "--inference.type=rtc", "--inference.queue_threshold=4")
    monkeypatch.undo()
    assert calls[0].left_over is None
    free = Loaded.of(path)
    chunks, num_guided = [], 0
    for i, call in enumerate(calls):
        free_1KD = free.policy.predict_action_chunk(call.batch)  # of the same noise
        left_KD = torch.zeros(0, len(KEYS)) if call.left_over is None else call.left_over
        left_KD = left_KD[left_KD.any(dim=1)]
        if len(left_KD):
            assert call.left_over is not None and len(call.left_over) > CHUNK
            assert torch.equal(left_KD, calls[i - 1].chunk[0, CHUNK - len(left_KD) :])
            firm = min(max(call.delay, 1), len(left_KD))
            distances = [
                (chunk_1KD[0, :firm] - left_KD[:firm]).abs().mean() for chunk_1KD in (call.chunk, free_1KD)
            ]
            assert distances[0] < 0.3 * distances[1]
            num_guided += 1
        else:  # the first one, and where a slow machine left nothing
            torch.testing.assert_close(call.chunk, free_1KD)
        chunks.append(free.physical(call.chunk))
    assert num_guided > 0
    # told: rows of the chunks, one after the other, and of a new chunk none that is over already
    places = [place_of(action_D, chunks) for action_D in told(arm)]
    assert places[0][0] == 0 and places == sorted(places)
    for (chunk, row), (next_chunk, next_row) in itertools.pairwise(places):
        assert next_row == row + 1 if next_chunk == chunk else next_row >= 1


def place_of(action_D: Tensor, chunks: list[Tensor]) -> tuple[int, int]:
    """(chunk, row) of the chunk that has this very action."""
    found = [
        (i, int(row)) for i, chunk_KD in enumerate(chunks)
        for row in ((chunk_KD - action_D).abs().max(dim=1).values < 1e-3).nonzero()[:, 0]
    ]  # fmt: skip
    assert len(found) == 1, found
    return found[0]


@pytest.mark.parametrize(
    ("name", "options"), [("vla0_smol", []), ("fdvla", ["--policy.use_flow_head=false"])]
)
def test_a_policy_without_real_time_chunking_says_so_before_the_arm_is_connected(
    name: str, options: list[str], checkpoint: Callable[..., Path], rollout: Callable[..., ScriptedArm]
) -> None:
    path, num_arms = checkpoint(name, *options), len(ScriptedArm.made)
    with pytest.raises(ValueError, match=f"RTC inference is not supported by policy type '{name}'"):
        rollout(path, 1, "--inference.type=rtc")
    assert len(ScriptedArm.made) == num_arms
