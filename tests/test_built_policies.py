"""Policies that a process has built, as an environment asks."""

import gc
from pathlib import Path
from types import SimpleNamespace

import pytest
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import PreTrainedPolicy, make_policy
from lerobot.policies.act.configuration_act import ACTConfig

import lerobot_policy_bomb  # noqa: F401  the plugin
from lerobot_bomb.compat.hooks.policies import built_policies, training_data
from lerobot_env_bomb.bomb.configuration_bomb import BombEnvConfig


@pytest.fixture
def before() -> list[PreTrainedPolicy]:
    """Return the policies that other tests hold."""
    gc.collect()
    return built_policies()


def act_config() -> ACTConfig:
    return ACTConfig(
        device="cpu",
        dim_model=8,
        n_heads=1,
        dim_feedforward=8,
        pretrained_backbone_weights=None,
        use_vae=False,
    )


def test_a_stock_policy_is_known_as_long_as_it_lives_from_a_folder_too(
    before: list[PreTrainedPolicy], tmp_path: Path
) -> None:
    env = BombEnvConfig(image_size=64)
    fresh = make_policy(act_config(), env_cfg=env)
    fresh.save_pretrained(tmp_path)
    config = act_config()
    config.pretrained_path = tmp_path
    loaded = make_policy(config, env_cfg=env)
    assert built_policies() == [*before, fresh, loaded]
    assert built_policies()[-1].config.pretrained_path == tmp_path
    assert training_data(loaded.config) is None
    del fresh, loaded
    gc.collect()
    assert built_policies() == before


def test_a_policy_that_is_being_trained_has_its_dataset(before: list[PreTrainedPolicy]) -> None:
    image = {"dtype": "image", "shape": (64, 64, 3), "names": ["height", "width", "channels"]}
    vector = {"dtype": "float32", "shape": (4,), "names": None}
    features = {"observation.images.workspace": image, "observation.state": vector, "action": vector}
    meta = SimpleNamespace(features=features, stats={}, fps=10)
    policy = make_policy(act_config(), ds_meta=meta)  # pyright: ignore[reportArgumentType]
    assert built_policies() == [*before, policy]
    assert policy.config.output_features == {"action": PolicyFeature(FeatureType.ACTION, (4,))}
    assert training_data(policy.config) is meta
