"""Entry point of the plugin: LeRobot imports it by name; it registers env types, policy types, processors."""

import lerobot_bomb.explain.interventions
import lerobot_env_bomb.configuration_bomb
import lerobot_env_bomb_libero.configuration_bomb_libero
import lerobot_env_bomb_pusht.configuration_bomb_pusht
import lerobot_policy_bomb_expert
import lerobot_policy_bomb_random
import lerobot_policy_fdvla
import lerobot_policy_spatialvla_grid
import lerobot_policy_vla0_smol
from lerobot_bomb._compat import (
    read_asked_columns,
    remember_policies,
    resolve_checkpoints,
    shorten_torchcodec_warning,
    tell_wrong_flags,
)
from lerobot_bomb.checkpoints.config import tell_config_errors
from lerobot_bomb.checkpoints.processor_files import check_saved_processors
from lerobot_bomb.checkpoints.shipped import checkpoint_path
from lerobot_bomb.data.hub_token import refuse_unsendable_tokens
from lerobot_bomb.data.missing import tell_missing_datasets
from lerobot_bomb.flag_errors import hint, refuse_unknown, tell_refusals

shorten_torchcodec_warning()
tell_config_errors()
remember_policies()
read_asked_columns()
refuse_unsendable_tokens()
tell_missing_datasets()
check_saved_processors()
resolve_checkpoints(checkpoint_path)
tell_wrong_flags(hint, refuse_unknown)
tell_refusals(
    [
        lerobot_bomb,
        lerobot_env_bomb,
        lerobot_env_bomb_libero,
        lerobot_env_bomb_pusht,
        lerobot_policy_bomb_expert,
        lerobot_policy_bomb_random,
        lerobot_policy_fdvla,
        lerobot_policy_spatialvla_grid,
        lerobot_policy_vla0_smol,
    ]
)
