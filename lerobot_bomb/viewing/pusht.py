"""Episodes of `bomb_pusht` as the tools show them."""

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium
import numpy as np

from lerobot_bomb.envs.rollout import Moment
from lerobot_bomb.pusht.episode import (
    BOARD_PX,
    FPS,
    IMAGE_SIZE,
    INSTRUCTIONS,
    MAX_STEPS,
    PushTSpec,
    check_image_size,
    check_installed,
)
from lerobot_bomb.results.pusht import PushTResult
from lerobot_bomb.viewing.episode import RANDOM, EnvView, Viewed
from lerobot_bomb.viewing.sheet import text_tile

if TYPE_CHECKING:
    from lerobot_bomb.viewing.film import Shot

ENV_ID = "lerobot_env_bomb:bomb_pusht/PushT-v0"
COVERAGE_AT = 0.95  # of the image's height, where the coverage stands
PUSHED_STEPS = 6  # through the block, to show what `dynamics` does


class PushTView(EnvView):
    """View of `bomb_pusht`, with its own flags."""

    flags: ClassVar = {
        "instruction": {"help": f"{' or '.join(INSTRUCTIONS)} (default: {INSTRUCTIONS[0]})"},
        "max_steps": {"type": int, "help": f"control steps (default: {MAX_STEPS})"},
    }

    def of_flags(self, flags: Mapping[str, Any]) -> Viewed:
        given = {name: flags[name] for name in self.flags if flags[name] is not None}
        spec = PushTSpec(flags["seed"], perturbations=flags["perturbations"], **given)
        return _episode(spec, IMAGE_SIZE if flags["image_size"] is None else flags["image_size"])

    def of_record(self, record: PushTResult, spec: PushTSpec, depth: bool) -> Viewed:
        return _episode(spec, record.image_size)

    def shot(self, env: gymnasium.Env, moment: Moment) -> "Shot":
        """Return the image for people, with the target's outline and how much of it is covered."""
        from lerobot_bomb.viewing.film import Marks, Shot

        image = np.asarray(env.render())
        side = image.shape[0]
        corners = env.get_wrapper_attr("target_outline")() * (side / BOARD_PX)
        outline = [(float(x), float(y)) for x, y in corners]
        coverage = moment.info.get("coverage")  # gym-pusht measures it after a step
        words = {} if coverage is None else {f"covered: {coverage:.0%}": (side / 2, COVERAGE_AT * side)}
        return Shot({"camera": image}, {"camera": Marks(words, [outline])})


def _episode(spec: PushTSpec, image_size: int) -> Viewed:
    """Return an episode to be shown.

    Raises:
        ValueError: gym-pusht is not installed, or draws no images of this size.
    """
    check_installed()
    check_image_size(image_size)
    return Viewed(
        env_type="bomb_pusht",
        spec=spec,
        group=f"pusht.{spec.condition.key}",
        fps=FPS,
        policies=(RANDOM,),
        env_flags={"image_size": image_size, "instruction": spec.instruction, "max_steps": spec.max_steps},
        make_env=partial(make_pusht_env, spec, image_size),
        log_at="lerobot_bomb.viewing.rerun_pusht:PushTLog",
    )


def make_pusht_env(spec: PushTSpec, image_size: int) -> gymnasium.Env:
    """Make `bomb_pusht` by Gymnasium's registry; gym-pusht must be installed."""
    return gymnasium.make(ENV_ID, disable_env_checker=True, spec=spec, image_size=image_size)


def pusht_tiles(condition: str, seed: int, image_size: int, changes: set[str]) -> dict[str, np.ndarray]:
    """Return tiles of the start; dynamics show after some steps through the block."""
    env = make_pusht_env(PushTSpec(seed, perturbations=condition), image_size)
    observation, info = env.reset(seed=seed)
    tiles = {}
    if "images" in changes:
        tiles["start"] = observation["pixels"]
    if "instruction" in changes:
        tiles["instruction"] = text_tile(env.get_wrapper_attr("task_description"), image_size)
    if "dynamics" in changes:
        beyond = np.clip(2 * info["block_pose"][:2] - info["pos_agent"], 40, 470)
        for _ in range(PUSHED_STEPS):
            observation, *_ = env.step(beyond)
        tiles[f"after {PUSHED_STEPS} steps"] = observation["pixels"]
    env.close()
    return tiles
