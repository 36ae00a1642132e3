"""A checkpoint that was trained for something else does not act on PushT unawares."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from lerobot.configs import PreTrainedConfig
from lerobot.envs import make_env_config, make_env_pre_post_processors
from lerobot.policies import PreTrainedPolicy, get_policy_class, make_policy, make_policy_config
from pusht_checkpoints import write_act
from vla0_smol_cases import make_config

from lerobot_bomb.bomb.environment import Environment

BOMB = Environment("scara", "absolute", 10, 64, ("workspace", "wrist"), "1.0", "place")
OVERRIDE = "or override with --env.ignore_checkpoint=true"


def load(folder: Path) -> PreTrainedPolicy:
    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path = folder
    return make_policy(config, env_cfg=make_env_config("bomb_pusht"))


def act_in(policy: PreTrainedPolicy, **flags: Any) -> None:
    """Do what every command does between building the policy that acts and its first episode."""
    make_env_pre_post_processors(make_env_config("bomb_pusht", **flags), policy.config)


def test_a_checkpoint_of_pusht_acts(tmp_path: Path) -> None:
    policy = load(write_act(tmp_path / "act"))
    act_in(policy, instruction="none")
    with pytest.raises(ValueError) as error:
        act_in(policy, image_size=128)
    assert str(error.value) == (
        f"the checkpoint {tmp_path}/act reads images of 96x96 pixels; this environment has "
        f"--env.image_size=128: evaluate with --env.image_size=96, {OVERRIDE}"
    )
    act_in(policy, image_size=128, ignore_checkpoint=True)


@pytest.mark.parametrize(
    ("low", "high", "shown"),
    [
        ((-1.0, -1.0), (1.0, 1.0), "from (-1, -1) to (1, 1)"),
        ((0.0, 0.0), (1.0, 1.0), "from (0, 0) to (1, 1)"),
        ((-80.5, -90.0), (91.0, 77.0), "from (-80.5, -90) to (91, 77)"),
        ((0.0, 0.0), (600.0, 512.0), "from (0, 0) to (600, 512)"),
    ],
)
def test_actions_of_another_unit_are_refused(
    low: tuple[float, float], high: tuple[float, float], shown: str, tmp_path: Path
) -> None:
    policy = load(write_act(tmp_path / "act", low=low, high=high))
    with pytest.raises(ValueError) as error:
        act_in(policy)
    assert str(error.value) == (
        f"the checkpoint {tmp_path}/act was trained on actions {shown}; those of --env.type=bomb_pusht are "
        f"pixels of the 512x512 board, 0 to 512: give a checkpoint of such actions, {OVERRIDE}"
    )
    act_in(policy, ignore_checkpoint=True)


def test_a_state_of_another_number_is_refused(tmp_path: Path) -> None:
    policy = load(write_act(tmp_path / "act", num_states=4))
    with pytest.raises(ValueError, match=r"has observation\.state of shape \(4,\), and --env\.type=bomb_pu"):
        act_in(policy)


def test_a_policy_that_was_trained_for_bomb_is_told_its_environment() -> None:
    config = replace(make_config(), environment=BOMB)
    policy: Any = get_policy_class("vla0_smol")(config)
    with pytest.raises(ValueError) as error:
        act_in(policy)
    assert str(error.value).startswith("this vla0_smol was trained for BOMB, task version 1.0, suite place")
    assert "this is --env.type=bomb_pusht: evaluate with --env.type=bomb --env.task=place" in str(error.value)
    assert str(error.value).endswith(OVERRIDE)
    act_in(policy, ignore_checkpoint=True)


def test_a_policy_without_training_acts() -> None:
    env = make_env_config("bomb_pusht")
    config = make_policy_config("act", pretrained_backbone_weights=None, device="cpu")
    policy = make_policy(config, env_cfg=env)  # kept: else one of another test may be the last that lives
    make_env_pre_post_processors(env, config)
    assert policy.config.type == "act"


def test_lerobot_eval_refuses_before_anything_is_run(stock_cli: Callable[..., None], tmp_path: Path) -> None:
    pytest.importorskip("gym_pusht", reason="gym-pusht is not installed: pip install '.[pusht]'")
    results = tmp_path / "results.jsonl"
    flags = [f"--policy.path={write_act(tmp_path / 'act', low=(-1.0, -1.0), high=(1.0, 1.0))}"]
    flags += ["--policy.device=cpu", "--env.type=bomb_pusht", f"--env.results_path={results}"]
    with pytest.raises(ValueError, match=r"was trained on actions from \(-1, -1\) to \(1, 1\)"):
        stock_cli("lerobot-eval", *flags, "--eval.n_episodes=1", f"--output_dir={tmp_path / 'eval'}")
    assert not results.exists()
