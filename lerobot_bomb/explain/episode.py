"""An episode, its moments and the findings about them."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import OBS_IMAGES

from lerobot_bomb.checkpoints.folder import autocast
from lerobot_bomb.explain.activations import LAYER, recording
from lerobot_bomb.explain.diagnosis import Finding, diagnose
from lerobot_bomb.explain.following import Following, following
from lerobot_bomb.explain.moment import Explanation, explain, finite, image_keys
from lerobot_bomb.explain.moment_query import OBSERVATION, MomentQuery
from lerobot_bomb.explain.next_actions import NextActions
from lerobot_bomb.explain.other_policies import scored
from lerobot_bomb.explain.pointing import PointingCheck, check_pointing
from lerobot_bomb.explain.question import Question
from lerobot_bomb.explain.scored_policy import ANSWER, INSTRUCTION, Batch
from lerobot_bomb.explain.snapshots import Snapshot
from lerobot_bomb.explain.spans import Span, named_spans, span_of, spans_of_words, token_offsets
from lerobot_bomb.viewing.checkpoint import LoadedPolicy


@dataclass(frozen=True)
class Settings:
    """Settings with which moments are explained."""

    grid: int
    fill: str
    words: tuple[str, ...] = ()  # to be hidden, beside those that are found


@dataclass(frozen=True)
class ExplainedMoment:
    """A moment, the findings about it, and its images."""

    snapshot: Snapshot
    explanation: Explanation
    findings: list[Finding]
    followings: dict[str, Following]
    images: dict[str, np.ndarray]  # (H, W, 3) uint8 by the keys of the explanation's patches
    states: dict[str, np.ndarray]  # (layers, F) by span, means over its tokens; {}: not to be had
    pointing: PointingCheck | None  # None: the policy does not point

    @property
    def title(self) -> str:
        """Title of the moment, such as "step 12, carry"."""
        return ", ".join(part for part in (f"step {self.snapshot.step}", self.snapshot.phase) if part)

    def as_json(self) -> dict[str, Any]:
        """Return the moment as JSON values, without the images."""
        return {
            "step": self.snapshot.step,
            "phase": self.snapshot.phase,
            "does": self.snapshot.does,
            "instruction": self.snapshot.instruction,
            "findings": {each.question: each.names for each in self.findings},
            "following": finite({word: asdict(each) for word, each in self.followings.items()}),
            **({} if self.pointing is None else {"pointing": self.pointing.as_json()}),
            **self.explanation.as_json(),
        }


def explain_moment(
    loaded: LoadedPolicy,
    snapshot: Snapshot,
    settings: Settings,
    control_mode: str | None,
    other: Snapshot,
) -> ExplainedMoment:
    """Explain a moment; ``other``: a moment of another episode, whose scene may replace this one's.

    ``control_mode``: of BOMB's actions; None elsewhere, where no action is a distance.
    """
    observation = loaded.observe([snapshot.observation], [snapshot.instruction])
    instead = loaded.observe([other.observation], [other.instruction])
    policy = scored(loaded.policy, loaded.postprocess)
    actions = None if control_mode is None else NextActions(loaded, policy, observation, control_mode)
    with torch.no_grad(), autocast(loaded.config):
        question = Question(policy, loaded.prepare, observation)
        explanation = explain(question, _query(loaded, snapshot, settings, instead), actions)
    followings = {}
    if snapshot.target is not None and actions is not None:
        followings = following(actions, snapshot.others, snapshot.target)
    images = {
        key: (255 * observation[key][0].permute(1, 2, 0)).round().to(torch.uint8).cpu().numpy()
        for key in image_keys(question)
    }
    states = mean_states(question)
    pointing = check_pointing(loaded, question.policy, observation, snapshot.state)
    findings = [*([] if pointing is None else [pointing.finding]), *diagnose(explanation)]
    return ExplainedMoment(snapshot, explanation, findings, followings, images, states, pointing)


def mean_states(question: Question) -> dict[str, np.ndarray]:
    """{instruction, answer: (layers, F) states}, means over tokens and draws; {} if not available."""
    policy = question.policy
    if not policy.layers or any(layer.layer is None for layer in policy.layers):
        return {}
    spans = policy.token_spans(question.rows)
    with torch.no_grad(), recording(policy.layers, [LAYER]) as activations:
        policy.score(question.rows, question.answer)
    found = {}
    for name in (INSTRUCTION, ANSWER):
        number, columns = next((i, each) for i, each in enumerate(spans[name]) if each is not None)
        states = [activations[layer, LAYER][number][:, columns] for layer in range(len(policy.layers))]
        found[name] = torch.stack([each.float().mean(dim=(0, 1)) for each in states]).cpu().numpy()
    return found


def _query(loaded: LoadedPolicy, snapshot: Snapshot, settings: Settings, instead: Batch) -> MomentQuery:
    try:
        offsets = token_offsets(loaded.prepare.steps, snapshot.instruction)
    except ValueError:
        if settings.words:
            raise
        offsets = []  # a policy that reads no instruction
    objects = {
        f"{OBS_IMAGES}.{camera}": {what: torch.from_numpy(mask) for what, mask in masks.items()}
        for camera, masks in snapshot.objects.items()
    }
    return MomentQuery(
        grid=settings.grid,
        fill=settings.fill,
        spans=[*_spans(snapshot, settings.words)] if offsets else [],
        offsets=offsets,
        others=snapshot.instructions if offsets else {},
        objects=objects,
        other_scene={key: value for key, value in instead.items() if key.startswith(OBSERVATION)},
    )


def _spans(snapshot: Snapshot, words: Sequence[str]) -> Iterator[Span]:
    """Yield the spans of row, column and colour, of each word of the instruction, and of `words`."""
    yield from named_spans(snapshot.instruction, snapshot.instructions)
    for span in spans_of_words(snapshot.instruction):
        yield Span(f'"{span.name}"', span.ranges)
    for each in words:
        yield span_of(each, snapshot.instruction)
