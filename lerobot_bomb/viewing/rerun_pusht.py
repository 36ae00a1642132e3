"""An episode of `bomb_pusht` as a recording for the viewer of Rerun."""

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from lerobot_bomb.envs.rollout import Moment
from lerobot_bomb.pusht.episode import FPS, PushTSpec
from lerobot_bomb.results.pusht import PushTResult
from lerobot_bomb.viewing.rerun_file import EpisodeLog, curve_views, describe_outcome, png, text_views

# positions in pixels of the board; how far the block is turned from the target
CURVES: dict[str, tuple[str, ...]] = {
    "action": ("x", "y"),
    "state": ("x", "y"),
    "block": ("x", "y"),
    "turned": ("degrees",),
}


class PushTLog(EpisodeLog[PushTSpec, PushTResult]):
    """Log of an episode of PushT: the policy's image, agent, block and coverage of the target."""

    @staticmethod
    def describe(result: PushTResult) -> str:
        outcome = describe_outcome(result.is_success, result.failure, result.steps)
        covered = f"{result.coverage:.3f} of the target, at its best moment {result.max_coverage:.3f}"
        return f"{outcome}; the block covers {covered}"

    @staticmethod
    def layout(prefix: str) -> rrb.Horizontal:
        """Lay out image and words at the left, curves at the right."""
        return rrb.Horizontal(
            rrb.Vertical(
                rrb.Spatial2DView(origin=f"{prefix}camera", name="camera"),
                rrb.Horizontal(*text_views(prefix, "instruction", "result")),
                row_shares=[3, 1],
            ),
            rrb.Vertical(*curve_views(prefix, *CURVES, "coverage")),
        )

    @staticmethod
    def _timing_and_curves(spec: PushTSpec) -> tuple[int, dict[str, tuple[str, ...]]]:
        return FPS, CURVES

    def _log_still(self, moment: Moment) -> None:
        pass

    def _log_moment(self, moment: Moment) -> None:
        block, goal = moment.info["block_pose"], moment.info["goal_pose"]
        turned_deg = (np.degrees(block[2] - goal[2]) + 180) % 360 - 180
        self._log("camera", png(moment.observation["pixels"]))
        self._log_values("state", moment.observation["agent_pos"])
        self._log_values("block", block[:2])
        self._log_values("turned", np.array([turned_deg]))
        if "coverage" in moment.info:  # gym-pusht measures it after a step
            self._log("coverage", rr.Scalars(float(moment.info["coverage"])))
