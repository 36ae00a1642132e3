"""Episodes in which something is hidden from the policy, or reworded, in every step."""

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
import torch
from lerobot.utils.constants import OBS_IMAGES

from lerobot_bomb.envs.rollout import Agent
from lerobot_bomb.explain.film import EpisodeRun, run_for_explanation
from lerobot_bomb.explain.images import filling, occluded
from lerobot_bomb.explain.mask_names import ANOTHER, HIDDEN_WORDS, NOTHING, OBJECT, WHOLE, mask_name
from lerobot_bomb.explain.other_policies import scored
from lerobot_bomb.explain.scored_policy import Batch
from lerobot_bomb.explain.snapshots import Snapshot
from lerobot_bomb.explain.spans import TOKENIZERS, Span, named_spans, token_offsets, whole
from lerobot_bomb.viewing.checkpoint import LoadedPolicy
from lerobot_bomb.viewing.episode import Viewed, ViewedRun

# observation and environment -> what the policy gets in its place
type Change = Callable[[Batch, gymnasium.Env], Batch]
# the preprocessor's output and the instruction -> what the policy gets in its place
type PreparedChange = Callable[[Batch, str], Batch]

BLURS = 16  # an image's side, in standard deviations of a blur


def nothing(batch: Batch, _: gymnasium.Env | str) -> Batch:
    """Change nothing."""
    return batch


@dataclass(frozen=True)
class Mask:
    """Changes of what the policy is given, before and after the preprocessor."""

    change: Change = nothing
    change_prepared: PreparedChange = nothing


def without_object(name: str, fill: str) -> Mask:
    """Take one object of `object_masks` out of every camera's image.

    Raises:
        ValueError: ``fill`` needs another episode.
    """

    def change(batch: Batch, env: gymnasium.Env) -> Batch:
        changed = dict(batch)
        for camera, masks in env.get_wrapper_attr("object_masks")().items():
            key = f"{OBS_IMAGES}.{camera}"
            (image,) = batch[key]
            mask = torch.from_numpy(masks[name])[None].to(image.device)
            changed[key] = occluded(image, mask, filling(image, fill, image.shape[-1] / BLURS))
        return changed

    return Mask(change=change)


def without_words(loaded: LoadedPolicy, words: Callable[[str], Span | None]) -> Mask:
    """Hide tokens of an instruction from all others; ``words``: instruction -> span to hide, or None."""
    policy = scored(loaded.policy, loaded.postprocess)

    def hide(prepared: Batch, instruction: str) -> Batch:
        span = words(instruction)
        if span is None:
            return prepared
        return policy.hide_in(prepared, span.tokens(token_offsets(loaded.prepare.steps, instruction)))

    return Mask(change_prepared=hide)


def with_other_words(others: Mapping[str, str]) -> Mask:
    """Give the policy other instructions; ``others``: instruction -> the one in its place."""

    def change(batch: Batch, _: gymnasium.Env) -> Batch:
        return {**batch, "task": [others.get(each, each) for each in batch["task"]]}

    return Mask(change=change)


def masks_of(snapshot: Snapshot, loaded: LoadedPolicy, fill: str) -> dict[str, Mask]:
    """Return the masks: nothing, each object, words for row, column and colour, all words, other words."""
    masks = {NOTHING: Mask()}
    masks |= {
        mask_name(OBJECT, name): without_object(name, fill)
        for name in next(iter(snapshot.objects.values()), {})
    }
    if any(isinstance(step, TOKENIZERS) for step in loaded.prepare.steps):
        for span in named_spans(snapshot.instruction, snapshot.instructions):
            by_instruction = {snapshot.instruction: span}
            masks[mask_name(HIDDEN_WORDS, span.name)] = without_words(loaded, by_instruction.get)
        masks[WHOLE] = without_words(loaded, whole)
        for word, other in snapshot.instructions.items():
            masks[mask_name(ANOTHER, word)] = with_other_words({snapshot.instruction: other})
    return masks


def run_masked(viewed: Viewed, loaded: LoadedPolicy, masks: Mapping[str, Mask]) -> dict[str, EpisodeRun]:
    """Run the same episode under each mask, from the same random state of the policy."""
    return {name: run_under(viewed, loaded, mask) for name, mask in masks.items()}


def run_under(viewed: Viewed, loaded: LoadedPolicy, mask: Mask, with_film: bool = False) -> EpisodeRun:
    """Run an episode under a mask."""
    loaded.begin()

    def masked(env: gymnasium.Env) -> AbstractContextManager[Agent]:
        def act(observation: dict[str, Any], instruction: str) -> np.ndarray:
            batch = mask.change(loaded.observe([observation], [instruction]), env)
            with torch.inference_mode():
                prepared = mask.change_prepared(loaded.prepare(batch), instruction)
            return loaded.act(prepared)[0]

        return nullcontext(act)

    return run_for_explanation(ViewedRun(viewed, masked), with_film)
