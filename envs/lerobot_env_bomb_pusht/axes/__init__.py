"""The perturbation axes, one file each; their levels and magnitudes: `lerobot_bomb.pusht.perturbations`."""

from lerobot_env_bomb_pusht.axes.dynamics import PushTDynamics
from lerobot_env_bomb_pusht.axes.goal import GoalPose
from lerobot_env_bomb_pusht.axes.goal_marker import GoalOutline
from lerobot_env_bomb_pusht.axes.language import PushTWording
from lerobot_env_bomb_pusht.axes.object import BlockShade
from lerobot_env_bomb_pusht.axes.photometric import PushTSensor
from lerobot_env_bomb_pusht.axes.start import PushTStart
from lerobot_env_bomb_pusht.axes.table import BoardLook
from lerobot_env_bomb_pusht.board import PushTTransform

PUSHT_TRANSFORMS: dict[str, type[PushTTransform]] = {
    "table": BoardLook,
    "start": PushTStart,
    "photometric": PushTSensor,
    "language": PushTWording,
    "dynamics": PushTDynamics,
    "object": BlockShade,
    "goal": GoalPose,
    "goal_marker": GoalOutline,
}
