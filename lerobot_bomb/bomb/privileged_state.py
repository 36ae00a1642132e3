"""The simulator's true state: what the expert reads, and its vector in the observation."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np

from lerobot_bomb.bomb.board import BOARD, NUM_STONES
from lerobot_bomb.bomb.episode import CONTROL_MODES, DEFAULT_FPS, Stage


@dataclass(frozen=True)
class Goal:
    """Goal of the expert: a stone, and its place."""

    xyz: np.ndarray  # (3,) metres, centre of the stone at rest there
    stone: int  # its index
    is_slid: bool = False  # along the board, without being lifted

    DIM = 4


@dataclass(frozen=True)
class PrivilegedState:
    """The simulator's true state, which the expert reads and no trained policy sees."""

    gripper_xyz: np.ndarray  # (3,) metres, point between the pads' lower ends
    finger_opening: float  # metres between the pads
    goals: tuple[Goal, ...]  # in the order in which they are to be reached
    stone_xyz: np.ndarray = field(repr=False)  # (NUM_STONES, 3) metres, centres
    stone_is_white: np.ndarray = field(repr=False)  # (NUM_STONES,) bool
    stone_in_play: np.ndarray = field(repr=False)  # (NUM_STONES,) bool; False: parked out of sight
    stage: Stage = Stage.START
    # how the environment reads actions
    control_mode: str = "relative"
    fps: int = DEFAULT_FPS
    stone_radius_m: float = BOARD.stone_radius_m
    max_opening_m: float = 0.044  # between the pads of open fingers
    # commands that latency holds back: motion (3,) in metres, and the gripper's command or 0
    pending_motion_m: np.ndarray = field(default_factory=lambda: np.zeros(3))
    pending_gripper: float = 0.0

    @property
    def stone_half_height_m(self) -> float:
        """Half the height of a stone: a goal is a stone at rest on board or tray, which are equally high."""
        return float(self.goals[0].xyz[2]) - BOARD.thickness_m

    @staticmethod
    def dim(num_goals: int) -> int:
        """Length of the vector with this number of goals."""
        return sum(part.size for part in _PARTS) + num_goals * Goal.DIM

    def to_vector(self) -> np.ndarray:
        """(dim(G),) float32, the observation ``environment_state``; G goals."""
        return np.concatenate([np.ravel(part.encode(self)) for part in _PARTS]).astype(np.float32)

    @classmethod
    def from_vector(cls, vector: np.ndarray) -> Self:
        """Inverse of `to_vector`, in float64.

        Raises:
            ValueError: no number of goals gives a vector of this length.
        """
        vector = np.asarray(vector, dtype=np.float64)
        goals_size = vector.size - cls.dim(0)
        if vector.ndim != 1 or goals_size <= 0 or goals_size % Goal.DIM:
            raise ValueError(
                f"environment_state has shape {vector.shape}, expected ({cls.dim(0)} + {Goal.DIM} per goal,)"
            )
        values: dict[str, Any] = {}
        for part in _PARTS:
            size = part.size or goals_size
            values |= part.decode(vector[:size])
            vector = vector[size:]
        return cls(**values)


@dataclass(frozen=True)
class _Part:
    """Part of the vector: how it is read from a state, and written back to one."""

    size: int  # 0: as many as the goals take
    encode: Callable[[PrivilegedState], Any]
    decode: Callable[[np.ndarray], dict[str, Any]]


def _vector(name: str, size: int) -> _Part:
    return _Part(size, lambda state: getattr(state, name), lambda numbers: {name: numbers})


def _number(name: str, kind: type[int | float]) -> _Part:
    return _Part(1, lambda state: getattr(state, name), lambda numbers: {name: kind(numbers[0])})


def _choice(name: str, choices: tuple[str, ...]) -> _Part:
    return _Part(
        1,
        lambda state: choices.index(getattr(state, name)),
        lambda numbers: {name: choices[int(numbers[0])]},
    )


def _encode_goals(state: PrivilegedState) -> list[float]:
    """Encode each goal as four numbers: its place, and the stone's index, plus NUM_STONES if it is slid."""
    return [number for goal in state.goals for number in (*goal.xyz, goal.stone + NUM_STONES * goal.is_slid)]


def _decode_goals(numbers: np.ndarray) -> dict[str, Any]:
    return {
        "goals": tuple(
            Goal(row[:3], int(row[3]) % NUM_STONES, row[3] >= NUM_STONES)
            for row in numbers.reshape(-1, Goal.DIM)
        )
    }


def _encode_stones(state: PrivilegedState) -> np.ndarray:
    """(NUM_STONES, 5): position, whether it is white, whether it is in play."""
    return np.concatenate(
        [state.stone_xyz, state.stone_is_white[:, None], state.stone_in_play[:, None]], axis=1
    )


def _decode_stones(numbers: np.ndarray) -> dict[str, Any]:
    stones = numbers.reshape(NUM_STONES, 5)
    return {
        "stone_xyz": stones[:, :3],
        "stone_is_white": stones[:, 3] > 0.5,
        "stone_in_play": stones[:, 4] > 0.5,
    }


# The vector, from its first number to its last.
_PARTS = (
    _vector("gripper_xyz", 3),
    _number("finger_opening", float),
    _Part(0, _encode_goals, _decode_goals),
    _choice("stage", tuple(Stage)),
    _choice("control_mode", CONTROL_MODES),
    _number("fps", int),
    _number("stone_radius_m", float),
    _number("max_opening_m", float),
    _vector("pending_motion_m", 3),
    _number("pending_gripper", float),
    _Part(5 * NUM_STONES, _encode_stones, _decode_stones),
)
