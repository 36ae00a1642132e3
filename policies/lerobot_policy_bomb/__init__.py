"""Entry point of the plugin: LeRobot imports it by name; it registers env types, policy types, processors."""

import lerobot_bomb.explain.interventions  # noqa: F401
import lerobot_env_bomb.configuration_bomb  # noqa: F401
import lerobot_policy_bomb_expert  # noqa: F401
import lerobot_policy_bomb_random  # noqa: F401
import lerobot_policy_fdvla  # noqa: F401
import lerobot_policy_spatialvla_grid  # noqa: F401
import lerobot_policy_vla0_smol  # noqa: F401
from lerobot_bomb.checkpoint_config import tell_config_errors
from lerobot_bomb.hub.processor_files import check_saved_processors

tell_config_errors()
check_saved_processors()
