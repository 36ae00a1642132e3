"""A checkpoint knows the environment that it was trained for, and every command that runs asks it."""

import json
import logging
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata, delete_episodes
from lerobot.envs import make_env_config, make_env_pre_post_processors
from lerobot.policies import (
    PreTrainedPolicy,
    get_policy_class,
    make_policy,
    make_policy_config,
    make_pre_post_processors,
)
from lerobot.utils.constants import ACTION, OBS_STATE
from policy_cases import CASES

import lerobot_policy_bomb  # noqa: F401  the plugin
from lerobot_bomb.bomb.environment import Environment
from lerobot_bomb.bomb.suite import task_version
from lerobot_bomb.checkpoints.environment import ConfigWithEnvironment
from lerobot_bomb.checkpoints.folder import parse_config, write_checkpoint
from lerobot_bomb.checkpoints.shipped import checkpoint_path
from lerobot_bomb.commands.main import main
from lerobot_bomb.conditions import ALL
from lerobot_bomb.flag_errors import FlagError

Run = Callable[..., None]
REPO_ID = "test/recording"
CAMERAS = ("workspace", "wrist")
ABSOLUTE = Environment("scara", "absolute", 10, 64, CAMERAS, "1.0", task="place", task_ids=(7, 12))
TO_ABSOLUTE = r"control_mode=absolute; this one has control_mode=relative: evaluate with " + (
    r"--env\.control_mode=absolute, or override with "
)


def record(root: Path, *flags: str) -> Path:
    size = ["--episodes=2", "--image_size=64", "--images"]
    assert main(["record", f"--repo_id={REPO_ID}", f"--root={root}", *size, *flags]) == 0
    return root


@pytest.fixture(scope="module")
def absolute(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("recorded") / "absolute"
    return record(root, "--control_mode=absolute", "--task_ids=[7,12]")


@pytest.fixture(scope="module")
def relative(absolute: Path) -> LeRobotDatasetMetadata:
    """Copy the frames with the names of a relative recording at 20 Hz, as an edited dataset would have."""
    root = absolute.with_name("relative")
    shutil.copytree(absolute, root)
    info = json.loads((root / "meta" / "info.json").read_text())
    info["features"]["action"]["names"] = ["dx", "dy", "dz", "gripper"]
    (root / "meta" / "info.json").write_text(json.dumps(info | {"fps": 20}))
    (root / "meta" / "bomb.json").unlink()
    return LeRobotDatasetMetadata(REPO_ID, root=root)


def new_policy(policy_type: str, dataset: Path) -> PreTrainedPolicy:
    """Build a policy as lerobot-train does."""
    options = {"has_depth": False} if policy_type == "spatialvla_grid" else {}
    config = CASES[policy_type].make_config(**options)
    config.input_features = {}
    return make_policy(config, ds_meta=LeRobotDatasetMetadata(REPO_ID, root=dataset))


def write(folder: Path, policy: PreTrainedPolicy) -> Path:
    ones = torch.ones(4)
    stats = {key: {"min": -ones, "max": ones, "mean": 0 * ones, "std": ones} for key in (ACTION, OBS_STATE)}
    write_checkpoint(folder, policy, make_pre_post_processors(policy.config, dataset_stats=stats))
    return folder


def act_in(policy: PreTrainedPolicy, **flags: object) -> None:
    """Do what every command does between building the policy that acts and its first episode."""
    make_env_pre_post_processors(make_env_config("bomb", **flags), policy.config)


def test_a_checkpoint_acts_in_its_own_environment_only(
    policy_type: str, absolute: Path, tmp_path: Path
) -> None:
    write(tmp_path / "checkpoint", new_policy(policy_type, absolute))
    config = parse_config(tmp_path / "checkpoint", "cpu")
    assert isinstance(config, ConfigWithEnvironment)
    assert config.environment == ABSOLUTE
    config.pretrained_path = tmp_path / "checkpoint"
    policy = make_policy(config, env_cfg=make_env_config("bomb", image_size=64))
    act_in(policy, control_mode="absolute", image_size=64, perturbations=["all:5"], split="heldout")
    with pytest.raises(ValueError, match=rf"{tmp_path}/checkpoint .*{TO_ABSOLUTE}--env\.ignore_checkpoint"):
        act_in(policy, image_size=64)
    with pytest.raises(ValueError, match=r"with --env\.fps=10 --env\.image_size=64, or"):
        act_in(policy, control_mode="absolute", fps=20, image_size=128)
    act_in(policy, image_size=64, ignore_checkpoint=True)
    with pytest.raises(FlagError, match=r"--policy\.ignore_environment=true is now --env\.ignore"):
        replace(config, ignore_environment=True)


def test_a_policy_that_goes_on_with_other_data_is_of_their_environment(
    policy_type: str,
    absolute: Path,
    relative: LeRobotDatasetMetadata,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    write(tmp_path, new_policy(policy_type, absolute))
    tuned = get_policy_class(policy_type).from_pretrained(tmp_path, dataset_meta=relative)
    assert "was trained for control_mode=absolute, fps=10; this dataset shows control_mode=rel" in caplog.text
    assert isinstance(tuned.config, ConfigWithEnvironment)
    expected = Environment("scara", "relative", 20, 64, CAMERAS, "1.0", task="place", task_ids=(7, 12))
    assert tuned.config.environment == expected


def test_commands_refuse_before_anything_is_run(
    absolute: Path, stock_cli: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path / "checkpoint", new_policy("vla0_smol", absolute))
    results = tmp_path / "results.jsonl"
    env = ["--env.type=bomb", "--env.image_size=64", f"--env.results_path={results}"]
    flags = [f"--policy.path={path}", *env, "--policy.device=cpu", f"--output_dir={tmp_path / 'eval'}"]
    with pytest.raises(ValueError, match=TO_ABSOLUTE):
        stock_cli("lerobot-eval", *flags)
    assert main(["results", "actions", str(tmp_path / "actions.jsonl"), *flags]) == 1
    assert "evaluate with --env.control_mode=absolute" in capsys.readouterr().err
    view = ["view", f"--policy.path={path}", "--control_mode=absolute", f"--output={tmp_path / 'view'}"]
    assert main([*view, "--image_size=128"]) == 1
    assert "evaluate with --env.image_size=64, or override with --env.ignore" in capsys.readouterr().err
    assert not results.exists()
    assert not [*tmp_path.rglob("*.mp4"), *tmp_path.rglob("*.rrd")]


ACT = "--policy.type=act --policy.dim_model=8 --policy.n_heads=1 --policy.dim_feedforward=8"
ACT += " --policy.use_vae=false --policy.pretrained_backbone_weights=null --policy.push_to_hub=false"


def test_stock_policies_know_it_by_the_dataset_of_their_training(
    absolute: Path, stock_cli: Run, tmp_path: Path
) -> None:
    root = tmp_path / "dataset"
    shutil.copytree(absolute, root)
    train = [f"--dataset.repo_id={REPO_ID}", f"--dataset.root={root}", "--batch_size=2", "--steps=1"]
    train += ["--num_workers=0", "--policy.device=cpu", *ACT.split(), f"--output_dir={tmp_path / 'train'}"]
    with pytest.raises(ValueError, match=rf"^this act .*{TO_ABSOLUTE}--env\.ignore_checkpoint=true"):
        stock_cli("lerobot-train", *train, "--env.type=bomb", "--env.image_size=64")
    assert not (tmp_path / "train").exists()
    stock_cli("lerobot-train", *train)

    path = tmp_path / "train" / "checkpoints" / "last" / "pretrained_model"
    evaluation = [f"--policy.path={path}", "--policy.device=cpu", f"--output_dir={tmp_path / 'eval'}"]
    with pytest.raises(ValueError, match=rf"{TO_ABSOLUTE}--env\.ignore_checkpoint=true"):
        stock_cli("lerobot-eval", *evaluation, "--env.type=bomb", "--env.image_size=64")
    shutil.rmtree(root)
    with pytest.raises(ValueError, match=r"reads images of 64x64 .* evaluate with --env\.image_size=64, or"):
        stock_cli("lerobot-eval", *evaluation, "--env.type=bomb", "--env.image_size=128")


def test_a_checkpoint_of_before_says_that_it_does_not_know(
    policy_type: str, absolute: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write(tmp_path, new_policy(policy_type, absolute))
    config = json.loads((tmp_path / "config.json").read_text())
    del config["environment"], config["ignore_environment"]
    (tmp_path / "config.json").write_text(json.dumps(config))
    read = parse_config(tmp_path, "cpu")
    read.pretrained_path = tmp_path
    policy = make_policy(read, env_cfg=make_env_config("bomb", image_size=64))
    with caplog.at_level(logging.WARNING):
        act_in(policy, image_size=64)
    assert [record.getMessage() for record in caplog.records if "does not know" in record.msg] == [
        f"the checkpoint {tmp_path} does not know the environment that it was trained for; only the size of "
        "its images could be compared. --env.control_mode, --env.fps and --env.robot must be those of its "
        "training"
    ]
    with pytest.raises(ValueError, match=r"evaluate with --env\.image_size=64, or override with --env\."):
        act_in(policy, image_size=128)


@pytest.mark.parametrize("untrained", ["bomb_expert", "bomb_random"])
def test_policies_without_training_act_anywhere(untrained: str, caplog: pytest.LogCaptureFixture) -> None:
    env = make_env_config("bomb", control_mode="absolute", fps=20)
    policy = make_policy(make_policy_config(untrained, device="cpu"), env_cfg=env)
    with caplog.at_level(logging.WARNING):
        act_in(policy, control_mode="absolute", fps=20)
    assert not [record for record in caplog.records if "does not know" in record.getMessage()]


@pytest.mark.parametrize("name", ["fdvla", "spatialvla_grid", "vla0_smol"])
def test_where_an_action_has_another_size_a_checkpoint_says_where_it_was_trained(name: str) -> None:
    config = PreTrainedConfig.from_pretrained(checkpoint_path(f"bomb:{name}"))
    config.pretrained_path, config.device = Path(checkpoint_path(f"bomb:{name}")), "cpu"
    told = "acts with 4 numbers, this environment takes 2; it was trained for BOMB, task version 1.0"
    with pytest.raises(ValueError, match=told):
        make_policy(config, env_cfg=make_env_config("bomb_pusht"))


def test_a_recording_that_lost_its_suite_trains_policies_that_say_so(
    policy_type: str, absolute: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Check what `lerobot-edit-dataset` leaves: neither bomb.json nor our columns of the kept episodes."""
    root = tmp_path / "kept"
    recorded = LeRobotDataset(REPO_ID, root=absolute, video_backend="pyav")
    delete_episodes(recorded, [0], output_dir=root, repo_id=REPO_ID)
    policy = new_policy(policy_type, root)
    assert f"{root} does not say which suite its episodes are of" in caplog.text
    write(tmp_path / "checkpoint", policy)
    del policy  # of two in one process, any may act
    config = parse_config(tmp_path / "checkpoint", "cpu")
    assert isinstance(config, ConfigWithEnvironment)
    assert config.environment == Environment("scara", "absolute", 10, 64, CAMERAS, task_version(ALL))
    config.pretrained_path = tmp_path / "checkpoint"
    loaded = make_policy(config, env_cfg=make_env_config("bomb", image_size=64))
    for suite in ("object", "place"):
        caplog.clear()
        act_in(loaded, control_mode="absolute", image_size=64, task=suite)
        assert "does not know the suite that it was trained for, so none was compared" in caplog.text
    with pytest.raises(ValueError, match=TO_ABSOLUTE):
        act_in(loaded, image_size=64, task="object")
