"""Depth on its way through LeRobot: evaluation, recording, training. It must arrive as metres, untouched."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.observation import CAMERAS, RenderOptions
from lerobot_bomb.commands.main import main
from lerobot_bomb.data import resumable
from lerobot_bomb.data.record import record
from lerobot_bomb.data.recording import Recording
from lerobot_bomb.data.rollout_pool import Rollout, RolloutSettings, collect
from lerobot_bomb.envs.rollout import make_env

SIZE, SEED, EPISODES = 64, 3, 3
OPTIONS = RenderOptions(image_size=SIZE, depth=True)
SHAPES = {"depth": (SIZE, SIZE), "intrinsics": (3, 3), "extrinsics": (4, 4)}
KEYS = {f"{kind}.{camera}" for kind in SHAPES for camera in CAMERAS}
REPO_ID = "test/depth"

Run = Callable[..., None]


@pytest.fixture(scope="module")
def rollouts() -> list[Rollout]:
    """Run the episodes that the recordings hold, directly."""
    spec = EpisodeSpec(seed=SEED)
    env = make_env(spec, OPTIONS)
    rollouts = [
        collect(env, EpisodeSpec(seed=seed), RolloutSettings(OPTIONS))
        for seed in range(SEED, SEED + EPISODES)
    ]
    env.close()
    assert all(rollout.result.is_success and rollout.geometry.keys() == KEYS for rollout in rollouts)
    return rollouts


@pytest.fixture(scope="module", params=["--images=false", "--images=true"])
def dataset(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record by the command, and merge from two blocks."""
    root = tmp_path_factory.mktemp("recorded") / "dataset"
    flags = [f"--repo_id={REPO_ID}", f"--root={root}", f"--episodes={EPISODES}", f"--seed={SEED}"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(resumable, "BLOCK_EPISODES", 2)
        assert main(["record", *flags, f"--image_size={SIZE}", "--depth", request.param]) == 0
    return root


def expected(rollouts: list[Rollout], key: str) -> np.ndarray:
    """(N, ...) values of all recorded frames."""
    return np.concatenate([rollout.geometry[key] for rollout in rollouts])


def test_a_dataset_gives_back_the_same_metres(dataset: Path, rollouts: list[Rollout]) -> None:
    from lerobot.datasets import LeRobotDataset

    recorded = LeRobotDataset(REPO_ID, root=dataset, video_backend="pyav")
    assert recorded.num_episodes == EPISODES
    for index in range(len(recorded)):
        item: Any = recorded[index]
        for key in KEYS:
            found = item[f"observation.{key}"].numpy()
            assert found.dtype == np.float32
            np.testing.assert_array_equal(found, expected(rollouts, key)[index])
    assert index + 1 == len(expected(rollouts, "depth.wrist"))


def test_features_agree_and_none_of_them_is_a_camera(dataset: Path) -> None:
    from lerobot.datasets import LeRobotDatasetMetadata
    from lerobot.envs import env_to_policy_features
    from lerobot.utils.feature_utils import dataset_to_policy_features

    from lerobot_env_bomb.bomb.configuration_bomb import BombEnvConfig

    metadata = LeRobotDatasetMetadata(REPO_ID, root=dataset)
    features = dataset_to_policy_features(metadata.features)
    assert features == env_to_policy_features(BombEnvConfig(image_size=SIZE, depth=True))
    for kind, shape in SHAPES.items():
        for camera in CAMERAS:
            feature = features[f"observation.{kind}.{camera}"]
            assert (feature.type.value, feature.shape) == ("STATE", shape)
    assert metadata.stats is not None  # what has none is not normalised
    assert not {f"observation.{key}" for key in KEYS} & metadata.stats.keys()
    assert {"observation.state", "observation.images.wrist"} < metadata.stats.keys()


def test_an_interrupted_recording_resumes_to_the_same_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from lerobot_bomb.data import blocks

    monkeypatch.setattr(resumable, "BLOCK_EPISODES", 1)
    recording = Recording(REPO_ID, episodes=2, seed=SEED, image_size=SIZE, depth=True)
    record(recording, tmp_path / "whole")
    write, started = blocks._write_episode, iter(range(9))

    def write_one(*args: Any) -> None:
        if next(started) == 1:
            raise KeyboardInterrupt
        write(*args)

    root = tmp_path / "resumed"
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(blocks, "_write_episode", write_one)
        record(recording, root)
    with pytest.raises(ValueError, match=r"--resume: .* differs in depth=False \(it has True\)"):
        record(Recording(REPO_ID, episodes=2, seed=SEED, image_size=SIZE), root, resume=True)
    record(recording, root, resume=True)
    whole, resumed = (
        {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        for folder in (tmp_path / "whole", root)
    )
    assert resumed == whole


@pytest.mark.parametrize("use_async", ["false", "true"])
def test_a_policy_in_lerobot_eval_gets_what_the_env_shows(
    use_async: str, stock_cli: Run, rollouts: list[Rollout], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from lerobot_policy_bomb.bomb_expert.modeling_bomb_expert import BombExpertPolicy

    batches, select_action = [], BombExpertPolicy.select_action

    def note(policy: BombExpertPolicy, batch: dict[str, Any], **kwargs: Any) -> Any:
        batches.append(batch)
        return select_action(policy, batch, **kwargs)

    monkeypatch.setattr(BombExpertPolicy, "select_action", note)
    flags = f"--policy.type=bomb_expert --policy.device=cpu --output_dir={tmp_path} --seed={SEED}"
    flags += f" --env.type=bomb --env.image_size={SIZE} --env.depth=true --eval.use_async_envs={use_async}"
    stock_cli("lerobot-eval", *flags.split(), "--eval.n_episodes=2", "--eval.batch_size=2")
    assert len(batches) == max(rollout.result.steps for rollout in rollouts[:2])
    for episode, rollout in enumerate(rollouts[:2]):
        for key in KEYS:
            for batch, values in zip(batches, rollout.geometry[key], strict=False):
                np.testing.assert_array_equal(batch[f"observation.{key}"][episode].numpy(), values)


@pytest.mark.parametrize("dataset", ["--images=false"], indirect=True)
def test_act_trains_as_without_depth(
    dataset: Path, rollouts: list[Rollout], stock_cli: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from lerobot.scripts import lerobot_train

    batches, update_policy = [], lerobot_train.update_policy

    def note(metrics: Any, policy: Any, batch: dict[str, Any], *args: Any, **kwargs: Any) -> Any:
        batches.append(batch)
        assert sorted(policy.config.image_features) == [f"observation.images.{name}" for name in CAMERAS]
        return update_policy(metrics, policy, batch, *args, **kwargs)

    monkeypatch.setattr(lerobot_train, "update_policy", note)
    flags = "--policy.type=act --policy.push_to_hub=false --policy.pretrained_backbone_weights=null --steps=1"
    flags += " --policy.dim_model=32 --policy.n_heads=2 --policy.dim_feedforward=32 --policy.device=cpu"
    flags += f" --dataset.repo_id={REPO_ID} --batch_size=2 --num_workers=0 --wandb.enable=false --save_freq=1"
    data = [f"--dataset.root={dataset}", f"--output_dir={tmp_path / 'train'}"]
    stock_cli("lerobot-train", *flags.split(), *data)
    (batch,) = batches
    for key in KEYS:
        for values, index in zip(batch[f"observation.{key}"], batch["index"], strict=True):
            np.testing.assert_array_equal(values.numpy(), expected(rollouts, key)[index])
    checkpoint = tmp_path / "train" / "checkpoints" / "last" / "pretrained_model"
    for depth in ("false", "true"):
        flags = f"--policy.path={checkpoint} --policy.device=cpu --env.type=bomb --env.image_size={SIZE}"
        flags += f" --env.fps=1 --env.ignore_checkpoint=true --env.depth={depth}"
        flags += " --eval.n_episodes=1 --eval.batch_size=1"
        stock_cli("lerobot-eval", *flags.split(), f"--output_dir={tmp_path / depth}")
        info = json.loads((tmp_path / depth / "eval_info.json").read_text())
        assert info["overall"]["n_episodes"] == 1


def test_wrong_flags_are_named(stock_cli: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["record", f"--repo_id={REPO_ID}", "--episodes=1", "--depth=maybe"])
    assert "--depth: 'maybe' must be true or false" in capsys.readouterr().err
    flags = f"--policy.type=bomb_expert --env.type=bomb --output_dir={tmp_path / 'eval'}"
    for wrong in ("--env.depth=maybe", "--env.depth=true --env.render_preset=shadows"):
        with pytest.raises(SystemExit):
            stock_cli("lerobot-eval", *flags.split(), *wrong.split())
        message = capsys.readouterr().err
        assert "depth" in message and ("maybe" in message or "needs --env.render_preset=fast" in message)
    assert list(tmp_path.iterdir()) == []
