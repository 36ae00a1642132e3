import numpy as np
import pytest
import torch
from lerobot.envs import make_env_config
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.policies.factory import make_policy_config

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.expert import expert_action
from lerobot_bomb.bomb.observation import RenderOptions, action_bounds
from lerobot_bomb.bomb.privileged_state import PrivilegedState
from lerobot_env_bomb.bomb.configuration_bomb import BombEnvConfig
from lerobot_env_bomb.bomb.env import BombEnv
from lerobot_policy_bomb.bomb_expert.configuration_bomb_expert import BombExpertConfig
from lerobot_policy_bomb.bomb_random.configuration_bomb_random import BombRandomConfig


def make(scripted_type: str, **fields: object):
    config = make_policy_config(scripted_type, device="cpu", **fields)
    return make_policy(config, env_cfg=BombEnvConfig())


def batch_of(num_rows: int, control_mode: str = "relative") -> dict[str, torch.Tensor]:
    """Observations of as many episodes as rows, at their start."""
    env = BombEnv(EpisodeSpec(seed=0, control_mode=control_mode), RenderOptions(image_size=32))
    rows = [env.reset(seed=seed)[0]["environment_state"] for seed in range(num_rows)]
    env.close()
    return {"observation.environment_state": torch.from_numpy(np.stack(rows))}


@pytest.mark.parametrize("control_mode", ["relative", "absolute"])
def test_random_actions_fill_the_action_space(control_mode: str) -> None:
    policy, batch = make("bomb_random"), batch_of(8, control_mode)
    actions = torch.cat([policy.select_action(batch) for _ in range(100)]).numpy()
    low, high = action_bounds(control_mode)
    assert (actions >= low).all() and (actions <= high).all()
    np.testing.assert_allclose(actions.mean(axis=0), (low + high) / 2, atol=0.06 * (high - low).max())
    np.testing.assert_allclose(actions.std(axis=0), (high - low) / np.sqrt(12), rtol=0.1)


def test_random_actions_do_not_depend_on_the_batch() -> None:
    policy, batch = make("bomb_random"), batch_of(4)
    together = policy.select_action(batch)
    policy.reset()
    alone = policy.select_action({key: value[2:3] for key, value in batch.items()})
    torch.testing.assert_close(alone[0], together[2], rtol=0, atol=0)
    assert len(torch.unique(together[:, 0])) == 4


def test_another_seed_gives_other_random_actions() -> None:
    batch = batch_of(1)
    first, second = make("bomb_random").select_action(batch), make("bomb_random", seed=1).select_action(batch)
    assert not torch.equal(first, second)


@pytest.mark.parametrize("control_mode", ["relative", "absolute"])
def test_expert_policy_acts_as_the_environment_reads_actions(control_mode: str) -> None:
    policy, batch = make("bomb_expert"), batch_of(1, control_mode)
    pre, post = make_pre_post_processors(policy.config)
    action = post(policy.select_action(pre({**batch, "task": ["anything"]})))
    state = PrivilegedState.from_vector(batch["observation.environment_state"][0].numpy())
    np.testing.assert_array_equal(action[0].numpy(), expert_action(state))
    assert state.control_mode == control_mode


@pytest.mark.parametrize("scripted_type", ["bomb_expert", "bomb_random"])
def test_scripted_policies_say_when_they_have_no_true_state(scripted_type: str) -> None:
    with pytest.raises(ValueError, match=r"needs the observation 'observation\.environment_state'"):
        make(scripted_type).select_action({"observation.state": torch.zeros(1, 4)})


@pytest.mark.parametrize("config_class", [BombExpertConfig, BombRandomConfig])
def test_scripted_policies_refuse_training(config_class: type) -> None:
    with pytest.raises(ValueError, match="is scripted and has nothing to train"):
        config_class(device="cpu").get_optimizer_preset()


def test_scripted_policies_refuse_other_robots() -> None:
    with pytest.raises(ValueError, match=r"acts in --env\.type=bomb only"):
        make_policy(make_policy_config("bomb_random", device="cpu"), env_cfg=make_env_config("pusht"))
