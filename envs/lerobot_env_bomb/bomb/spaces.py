"""Gymnasium's spaces of BOMB's actions and observations."""

import numpy as np
from gymnasium import spaces

from lerobot_bomb.bomb.board import NUM_STONES
from lerobot_bomb.bomb.episode import PHYSICS_HZ, Stage
from lerobot_bomb.bomb.observation import (
    AGENT_POS,
    CAMERAS,
    ENVIRONMENT_STATE,
    PIXELS,
    RenderOptions,
    action_bounds,
    geometry_shapes,
    state_names,
)
from lerobot_bomb.bomb.privileged_state import PrivilegedState

# Bounds of what the simulator can report, metres. Stones can be flung off the board, so bounds are wide.
POSITION_LIMIT_M = 100.0
# Pads that scrape over the board at metres per second drag fingers past their soft stops: docs/bomb.md.
GRIPPER_LIMIT_M = 1.0
JOINT_LIMIT = 360.0  # degrees, percent


def action_space(control_mode: str) -> spaces.Box:
    """float32: (4,), relative in units of MAX_STEP_M or absolute in metres; (6,) joints, in degrees."""
    low, high = action_bounds(control_mode)
    return spaces.Box(low, high, dtype=np.float32)


def observation_space(options: RenderOptions, num_goals: int, control_mode: str) -> spaces.Dict:
    """Images of both cameras, state of gripper or joints, the privileged state for oracles, geometry."""
    shape = (options.image_size, options.image_size, 3)
    state_limit = JOINT_LIMIT if control_mode == "joints" else GRIPPER_LIMIT_M
    limit = max(POSITION_LIMIT_M, NUM_STONES, len(Stage), PHYSICS_HZ)
    return spaces.Dict(
        {
            PIXELS: spaces.Dict({camera: spaces.Box(0, 255, shape, np.uint8) for camera in CAMERAS}),
            AGENT_POS: spaces.Box(-state_limit, state_limit, (len(state_names(control_mode)),), np.float32),
            ENVIRONMENT_STATE: spaces.Box(-limit, limit, (PrivilegedState.dim(num_goals),), np.float32),
            **{
                key: spaces.Box(-np.inf, np.inf, shape, np.float32)
                for key, shape in geometry_shapes(options).items()
            },
        }
    )
