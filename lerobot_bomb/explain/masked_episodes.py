"""Episodes in which something is hidden from the policy in every step."""

from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
import torch
from lerobot.utils.constants import OBS_IMAGES

from lerobot_bomb.envs.rollout import run_episode
from lerobot_bomb.explain.film import EpisodeCollector, EpisodeRun
from lerobot_bomb.explain.images import filling, occluded
from lerobot_bomb.explain.other_policies import scored
from lerobot_bomb.explain.scored_policy import Batch
from lerobot_bomb.explain.snapshots import Snapshot
from lerobot_bomb.explain.spans import TOKENIZERS, Span, named_spans, token_offsets, whole
from lerobot_bomb.viewing.checkpoint import LoadedPolicy
from lerobot_bomb.viewing.episode import Viewed

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
    """Changes that hide something from the policy, before and after the preprocessor."""

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


def masks_of(snapshot: Snapshot, loaded: LoadedPolicy, fill: str) -> dict[str, Mask]:
    """Return the masks: nothing, kinds of objects, words for row, column and colour, all words."""
    masks = {"nothing": Mask()}
    masks |= {
        f"object: {name}": without_object(name, fill) for name in next(iter(snapshot.objects.values()), {})
    }
    if any(isinstance(step, TOKENIZERS) for step in loaded.prepare.steps):
        for span in named_spans(snapshot.instruction, snapshot.instructions):
            by_instruction = {snapshot.instruction: span}
            masks[f"words: {span.name}"] = without_words(loaded, by_instruction.get)
        masks["the whole instruction"] = without_words(loaded, whole)
    return masks


def run_masked(viewed: Viewed, loaded: LoadedPolicy, masks: Mapping[str, Mask]) -> dict[str, EpisodeRun]:
    """Run the same episode under each mask, from the same random state of the policy."""
    return {name: run_under(viewed, loaded, mask) for name, mask in masks.items()}


def run_under(viewed: Viewed, loaded: LoadedPolicy, mask: Mask, with_film: bool = False) -> EpisodeRun:
    """Run an episode under a mask."""
    loaded.begin()
    with closing(viewed.make_env()) as env:
        collector = EpisodeCollector(viewed, env, with_film)

        def act(observation: dict[str, Any], instruction: str) -> np.ndarray:
            batch = mask.change(loaded.observe([observation], [instruction]), env)
            with torch.inference_mode():
                prepared = mask.change_prepared(loaded.prepare(batch), instruction)
            return loaded.act(prepared)[0]

        for moment in run_episode(env, viewed.spec, act):
            collector.add(moment)
        return collector.end()
