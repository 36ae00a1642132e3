"""Entry point of the plugin: LeRobot imports it by name; it registers env types, policy types, processors."""

# ruff: noqa: F401  importing registers

import lerobot_bomb.explain.interventions
import lerobot_env_bomb.bomb.configuration_bomb
import lerobot_env_bomb.libero.configuration_bomb_libero
import lerobot_env_bomb.pusht.configuration_bomb_pusht
import lerobot_policy_bomb.bomb_expert
import lerobot_policy_bomb.bomb_random
import lerobot_policy_bomb.fdvla
import lerobot_policy_bomb.spatialvla_grid
import lerobot_policy_bomb.vla0_smol
from lerobot_bomb.checkpoints.config import config_damage
from lerobot_bomb.checkpoints.environment import complete_evaluation
from lerobot_bomb.checkpoints.names import is_hub_id
from lerobot_bomb.checkpoints.processor_files import check_saved_processors
from lerobot_bomb.checkpoints.shipped import checkpoint_path
from lerobot_bomb.compat.hooks.datasets import explain_missing_datasets, keep_frames_in_memory
from lerobot_bomb.compat.hooks.errors import tell_config_errors, tell_refusals
from lerobot_bomb.compat.hooks.evaluation import check_evaluations
from lerobot_bomb.compat.hooks.flags import tell_wrong_flags
from lerobot_bomb.compat.hooks.hub import check_tokens_before_use, publish_as_the_policy_says
from lerobot_bomb.compat.hooks.paths import resolve_checkpoints
from lerobot_bomb.compat.hooks.policies import remember_policies
from lerobot_bomb.compat.hooks.torchcodec import shorten_torchcodec_warning
from lerobot_bomb.compat.use import register
from lerobot_bomb.data.hub_token import check_token_characters
from lerobot_bomb.data.kept_frames import keep_frames
from lerobot_bomb.data.missing import describe_missing_dataset
from lerobot_bomb.flag_errors import hint, refuse_unknown
from lerobot_bomb.results.names import SHIPPED_PREFIX

OURS = ("lerobot_bomb", "lerobot_env_bomb", "lerobot_policy_bomb")

resolve_checkpoints(SHIPPED_PREFIX, checkpoint_path)
register(
    OURS,
    [
        remember_policies,
        check_saved_processors,
        lambda: tell_config_errors(is_hub_id, config_damage),
        tell_refusals,
        lambda: tell_wrong_flags(hint, refuse_unknown),
        lambda: explain_missing_datasets(describe_missing_dataset),
        lambda: keep_frames_in_memory(keep_frames),
        lambda: check_evaluations(complete_evaluation),
        lambda: check_tokens_before_use(check_token_characters),
        publish_as_the_policy_says,
        shorten_torchcodec_warning,
    ],
)
