"""SpatialVLA-grid: PaliGemma 2 chooses cells of adaptive action grids; its patches know where they are."""

from lerobot_policy_bomb.spatialvla_grid.configuration_spatialvla_grid import SpatialvlaGridConfig
from lerobot_policy_bomb.spatialvla_grid.processor_spatialvla_grid import (
    make_spatialvla_grid_pre_post_processors,
)

__all__ = ["SpatialvlaGridConfig", "make_spatialvla_grid_pre_post_processors"]
