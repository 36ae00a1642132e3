"""gym-pusht's simulation, which the perturbation axes change."""

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, cast

import numpy as np
import pygame
from gym_pusht.envs.pusht import PushTEnv, pymunk_to_shapely

from lerobot_bomb.envs.perturbation import EpisodeTransform
from lerobot_bomb.pusht.episode import BOARD_PX

MIDDLE_PX = BOARD_PX / 2
WHITE, OUTLINE_RGB = (255, 255, 255), (220, 30, 30)
PERSON_IMAGE_SIZE = 384  # pixels, of LeRobot's videos of `pusht`


class PushTTransform(EpisodeTransform):
    """Effect of one perturbation axis on an episode of PushT; frozen once drawn."""

    def edit(self, board: "Board") -> None:
        """Change the board that gym-pusht has just set up, before block and agent are placed."""

    def arrange(self, state: np.ndarray) -> np.ndarray:
        """(5,) agent's x, y, block's x, y in pixels and angle in radians -> (5,) after the change."""
        return state


class Board(PushTEnv):
    """PushT's environment with transforms; without transforms it is gym-pusht, bit for bit.

    Overridden methods only add to it, or are faster.
    """

    def __init__(self, image_size: int):
        super().__init__(
            obs_type="pixels_agent_pos",
            observation_width=image_size,
            observation_height=image_size,
            visualization_width=PERSON_IMAGE_SIZE,
            visualization_height=PERSON_IMAGE_SIZE,
        )
        self._transforms: Sequence[PushTTransform] = ()
        self.background: Callable[[pygame.Surface], None] | None = None  # draws it in place of white
        self.outline_px = 0  # width of a line around the target
        self.touched = False  # whether the agent has touched the block since the start

    def begin(self, seed: int, transforms: Sequence[PushTTransform]) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start the episode of a seed; nothing of an earlier one is left, not even the drawn action."""
        self._transforms, self._last_action = transforms, None
        observation, info = self.reset(seed=seed)
        self.touched = False
        return cast("dict[str, Any]", observation), info

    @property
    def block_pose(self) -> np.ndarray:
        """(3,) x, y in pixels and angle in radians."""
        return np.array([*self.block.position, self.block.angle])

    def _setup(self) -> None:
        super()._setup()
        self.background, self.outline_px = None, 0
        for each in self._transforms:
            each.edit(self)

    def _set_state(self, state: np.ndarray) -> None:
        for each in self._transforms:
            state = each.arrange(state)
        super()._set_state(state)

    def _get_coverage(self) -> float:
        """Compute gym-pusht's coverage, bar before stem: in a set's order, its last bits vary by process."""
        goal = pymunk_to_shapely(self.get_goal_pose_body(self.goal_pose), self._block_shapes)
        block = pymunk_to_shapely(self.block, self._block_shapes)
        return goal.intersection(block).area / goal.area

    def _handle_collision(self, arbiter: Any, space: Any, data: Any) -> None:
        super()._handle_collision(arbiter, space, data)
        self.touched = self.touched or any(shape.body is self.agent for shape in arbiter.shapes)

    def _draw(self) -> pygame.Surface:
        screen = super()._draw()
        if self.background is not None:
            behind = self._behind
            self.background(behind)
            screen.set_colorkey(WHITE)
            behind.blit(screen, (0, 0))
            screen = behind
        if self.outline_px:
            self._draw_outline(screen)
        return screen

    def _get_img(
        self, screen: pygame.Surface, width: int, height: int, render_action: bool = False
    ) -> np.ndarray:
        """Draw gym-pusht's image without its strided copy of the screen, nearly half of a reset's time."""
        if render_action:
            return super()._get_img(screen, width, height, render_action)
        import cv2

        rgb = np.frombuffer(pygame.image.tobytes(screen, "RGB"), np.uint8).reshape(BOARD_PX, BOARD_PX, 3)
        return cv2.resize(rgb, (width, height))

    @cached_property
    def _behind(self) -> pygame.Surface:
        """Return the image below a board that is not white."""
        return pygame.Surface((BOARD_PX, BOARD_PX))

    def _draw_outline(self, screen: pygame.Surface) -> None:
        """Draw a line around the target."""
        pygame.draw.lines(screen, OUTLINE_RGB, True, self.target_outline.tolist(), self.outline_px)

    @property
    def target_outline(self) -> np.ndarray:
        """(8, 2) pixels of the board, the corners of the target, in order."""
        goal = self.get_goal_pose_body(self.goal_pose)
        bar, stem = (shape.get_vertices() for shape in self._block_shapes)
        corners = tee_outline(np.array(bar), np.array(stem))
        return np.array([goal.local_to_world(tuple(corner)) for corner in corners.tolist()])


def tee_outline(bar: np.ndarray, stem: np.ndarray) -> np.ndarray:
    """(4, 2) corners of the bar and of the stem below it -> (8, 2) corners of the T, in order."""
    (left, top), (right, bottom) = bar.min(0), bar.max(0)
    (stem_left, _), (stem_right, end) = stem.min(0), stem.max(0)
    outline = [
        (left, top), (right, top), (right, bottom), (stem_right, bottom),
        (stem_right, end), (stem_left, end), (stem_left, bottom), (left, bottom),
    ]  # fmt: skip
    return np.array(outline)
