"""The policies that come with the package, asked about one observation of BOMB."""

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.observation import RenderOptions
from lerobot_bomb.bomb.suite import find_suite
from lerobot_bomb.checkpoints.shipped import checkpoint_path, shipped_names
from lerobot_bomb.envs.rollout import expert_agent, make_env, run_episode
from lerobot_bomb.explain.images import filling
from lerobot_bomb.explain.moment_query import MomentQuery
from lerobot_bomb.explain.other_policies import scored
from lerobot_bomb.explain.question import Question
from lerobot_bomb.explain.scored_policy import ScoredPolicy
from lerobot_bomb.explain.spans import difference, token_offsets
from lerobot_bomb.viewing.checkpoint import LoadedPolicy, load_policy

NAMES = [name for name in shipped_names() if not name.endswith("_suites")]  # one of each type
# for tests that explain a whole moment: fdvla's sampling steps take longest
FAST_NAMES = [pytest.param(name, marks=pytest.mark.long if name == "fdvla" else ()) for name in NAMES]
SPEC = EpisodeSpec(seed=100_003, target=(1, 3), color="black")
OPTIONS = RenderOptions(image_size=64)
FAR_M = 0.05  # the stone is carried, and where it is to go decides what comes next
GRID = 4
WORKSPACE, WRIST = "observation.images.workspace", "observation.images.wrist"


def fresh(name: str, device: str = "cpu", flags: Sequence[str] = ()) -> LoadedPolicy:
    """One that a test may change."""
    path = Path(checkpoint_path(f"bomb:{name}"))
    return load_policy(path, device, "bomb", {"image_size": 64}, seed=0, policy_flags=flags)


loaded = cache(fresh)


def scored_by(policy: LoadedPolicy) -> ScoredPolicy:
    """Explain the policy as it says how."""
    return scored(policy.policy, policy.postprocess)


@cache
def moment() -> tuple[dict[str, Any], str, dict[str, dict[str, Any]], dict[str, Any]]:
    """An observation, its instruction, the masks of its objects, the other instructions."""
    with closing(make_env(SPEC, OPTIONS)) as env:
        for each in run_episode(env, SPEC, expert_agent()):
            goal = each.state.goals[0]
            distance_m = np.linalg.norm(each.state.stone_xyz[goal.stone][:2] - goal.xyz[:2])
            if each.info["stage"] == "lifted" and distance_m > FAR_M:
                masks = env.get_wrapper_attr("object_masks")()
                return each.observation, each.instruction, masks, env.get_wrapper_attr("alternatives")()
    raise AssertionError("the episode is shorter")


def end_episodes_after(max_steps: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let episodes of `place` end early, whose many steps most of an explanation's time would go to."""
    suite = replace(find_suite("place"), max_steps=max_steps)
    monkeypatch.setattr("lerobot_env_bomb.bomb.env.find_suite", lambda _: suite)


def ask(
    policy: LoadedPolicy,
    prepare: Callable[[dict[str, Any]], dict[str, Any]] | None = None,
    batch_size: int = 64,
) -> Question:
    """The observation, asked of a policy; ``prepare``: what stands for its preprocessor."""
    observation, instruction, _, _ = moment()
    raw = policy.observe([observation], [instruction])
    return Question(scored_by(policy), prepare or policy.prepare, raw, batch_size)


def query(policy: LoadedPolicy) -> MomentQuery:
    """Patches, the words of the target and of the colour."""
    _, instruction, _, others = moment()
    spans = [difference(word, instruction, other) for word, (other, _) in others.items()]
    return MomentQuery(
        grid=GRID,
        fill="mean",
        spans=[span for span in spans if span is not None],
        offsets=token_offsets(policy.prepare.steps, instruction),
        others={word: other for word, (other, _) in others.items()},
    )


def without_image(question: Question, key: str = WORKSPACE) -> dict[str, Any]:
    """Encode the question with one camera that shows its mean colour only."""
    (image,) = question.observation[key]
    return question.encode({key: filling(image, "mean", 1.0)[None]}, 1)
