import numpy as np
import pytest
import torch
from lerobot.envs import make_env_config
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.policies.factory import make_policy_config

from lerobot_bomb.schema import PrivilegedState, action_bounds
from lerobot_env_bomb.env import BombEnv
from lerobot_policy_bomb_expert.configuration_bomb_expert import BombExpertConfig
from lerobot_policy_bomb_random.configuration_bomb_random import BombRandomConfig


def make(policy_type: str, **fields: object):
    config = make_policy_config(policy_type, device="cpu", **fields)
    return make_policy(config, env_cfg=make_env_config("bomb"))


def states(n: int) -> dict[str, torch.Tensor]:
    rows = np.random.default_rng(0).uniform(-0.1, 0.1, size=(n, 4)).astype(np.float32)
    return {"observation.state": torch.from_numpy(rows)}


@pytest.mark.parametrize("control_mode", ["relative", "absolute"])
def test_random_actions_fill_the_action_space(control_mode: str) -> None:
    policy = make("bomb_random", control_mode=control_mode)
    actions = torch.cat([policy.select_action(states(8)) for _ in range(100)]).numpy()
    low, high = action_bounds(control_mode)
    assert (actions >= low).all() and (actions <= high).all()
    np.testing.assert_allclose(actions.mean(axis=0), (low + high) / 2, atol=0.06 * (high - low).max())
    np.testing.assert_allclose(actions.std(axis=0), (high - low) / np.sqrt(12), rtol=0.1)


def test_random_actions_do_not_depend_on_the_batch() -> None:
    policy, batch = make("bomb_random"), states(4)
    together = policy.select_action(batch)
    policy.reset()
    torch.testing.assert_close(
        policy.select_action({key: value[2:3] for key, value in batch.items()})[0],
        together[2],
        rtol=0,
        atol=0,
    )
    assert len(torch.unique(together[:, 0])) == 4


def test_another_seed_gives_other_random_actions() -> None:
    assert not torch.equal(make("bomb_random").select_action(states(1)),
                           make("bomb_random", seed=1).select_action(states(1)))  # fmt: skip


def test_expert_policy_acts_like_the_expert_of_the_recorder() -> None:
    from lerobot_bomb.expert import expert_action

    env = BombEnv()
    vector = env.reset(seed=4)[0]["environment_state"]
    env.close()
    policy = make("bomb_expert")
    pre, post = make_pre_post_processors(policy.config)
    batch = pre({"observation.environment_state": torch.from_numpy(vector)[None], "task": ["anything"]})
    action = post(policy.select_action(batch))
    np.testing.assert_array_equal(action[0].numpy(), expert_action(PrivilegedState.from_vector(vector)))


def test_expert_policy_says_when_it_has_no_true_state() -> None:
    with pytest.raises(ValueError, match=r"needs the observation 'observation\.environment_state'"):
        make("bomb_expert").select_action(states(1))


@pytest.mark.parametrize("config_class", [BombExpertConfig, BombRandomConfig])
def test_scripted_policies_refuse_training_and_unknown_control(config_class: type) -> None:
    with pytest.raises(ValueError, match="is scripted and has nothing to train"):
        config_class(device="cpu").get_optimizer_preset()
    with pytest.raises(ValueError, match=r"--policy\.control_mode='joint'"):
        config_class(device="cpu", control_mode="joint")


def test_scripted_policies_refuse_other_robots() -> None:
    with pytest.raises(ValueError, match="acts on BOMB only"):
        make_policy(make_policy_config("bomb_random", device="cpu"), env_cfg=make_env_config("pusht"))
