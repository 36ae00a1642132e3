"""Perturbation axis `dynamics`: how the block glides and rubs, and how the agent obeys."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from lerobot_bomb.pusht.perturbations import pusht_magnitude
from lerobot_env_bomb.pusht.board import Board, PushTTransform


@dataclass(frozen=True)
class PushTDynamics(PushTTransform):
    """Damping and friction of the block; noise and latency of the agent."""

    damping: float  # share of a speed that is left after a second; gym-pusht's is 0
    friction: float  # between agent and block; gym-pusht's is 0
    noise_px: float  # standard deviation on executed x and y
    latency: int  # control steps

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: object) -> Self:
        return cls(
            damping=float(np.exp(-1 / pusht_magnitude("dynamics", "glide", level))),
            friction=pusht_magnitude("dynamics", "friction", level),
            noise_px=pusht_magnitude("dynamics", "noise", level),
            latency=int(pusht_magnitude("dynamics", "latency", level)),
        )

    def edit(self, board: Board) -> None:
        board.space.damping = self.damping
        # a contact has the product of both; the walls' is 0
        for shape in (*board.agent.shapes, *board.block.shapes):
            shape.friction = self.friction**0.5
