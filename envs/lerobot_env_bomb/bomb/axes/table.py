# pyright: reportAttributeAccessIssue=false
"""Perturbation axis `table`: colour and pattern of the table."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from lerobot_bomb.bomb.perturbations import magnitude
from lerobot_bomb.bomb.suite import Episode
from lerobot_env_bomb.bomb.axes.transform import Transform
from lerobot_env_bomb.bomb.model import TABLE_PATTERNS, table_material
from lerobot_env_bomb.shared.mujoco_gl import mujoco

# Neither black nor white, so that stones of both colours show on them.
TABLE_RGB = (
    (0.62, 0.30, 0.26),
    (0.66, 0.50, 0.24),
    (0.44, 0.56, 0.26),
    (0.22, 0.50, 0.48),
    (0.28, 0.36, 0.62),
    (0.50, 0.32, 0.58),
    (0.58, 0.44, 0.40),
    (0.30, 0.50, 0.34),
)
TRAY_SHARE = 0.75  # of a table's colour; under bright light a lighter tray is as white as a stone
HELDOUT_TABLE_RGB = ((0.62, 0.36, 0.48), (0.34, 0.46, 0.34))


@dataclass(frozen=True)
class TableLook(Transform):
    """Colour and pattern of the table, colour of the tray."""

    level: int
    table_rgb: tuple[float, float, float]
    tray_rgb: tuple[float, float, float]
    pattern: str

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: Episode) -> Self:
        palette = {"all": TABLE_RGB + HELDOUT_TABLE_RGB, "train": TABLE_RGB, "heldout": HELDOUT_TABLE_RGB}[
            nominal.spec.split
        ]
        table, tray = rng.choice(len(palette), size=2, replace=False)
        return cls(level, palette[table], palette[tray], TABLE_PATTERNS[rng.integers(len(TABLE_PATTERNS))])

    def edit_model(self, model: mujoco.MjModel) -> None:
        share = magnitude("table", "color", self.level)
        patterned = model.material(table_material(self.pattern, self.level))
        for material, nominal, rgb in (
            (patterned, model.material("table"), np.array(self.table_rgb)),
            (model.material("mat"), model.material("mat"), TRAY_SHARE * np.array(self.tray_rgb)),
        ):
            material.rgba[:3] = (1 - share) * nominal.rgba[:3] + share * rgb
        model.geom("table").matid = patterned.id
