"""Explanation of one moment of an episode: all questions to a policy about it.

Shapes: `G` cells along a side of the grid over an image, `L` layers.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from lerobot.utils.constants import OBS_IMAGE
from torch import Tensor

from lerobot_bomb.explain.images import filling, occluded, patch_masks
from lerobot_bomb.explain.limits import ALL
from lerobot_bomb.explain.moment_query import MomentQuery
from lerobot_bomb.explain.next_actions import NextActions
from lerobot_bomb.explain.patching import PatchingResult, corruptions, restore
from lerobot_bomb.explain.question import Question
from lerobot_bomb.explain.scored_policy import Batch


@dataclass(frozen=True)
class Moved:
    """Distances in millimetres by which the next executed actions change, in place of drops of the score."""

    patches: dict[str, Tensor]
    objects: dict[str, dict[str, float]]
    words: dict[str, float]
    others: dict[str, float]


@dataclass(frozen=True)
class Explanation:
    """Effects on the score of the clean answer: how far it drops."""

    unit: str
    clean_score: float
    patches: dict[str, Tensor]  # (G, G) by key of the image
    objects: dict[str, dict[str, float]]  # by key of the image, or ALL, and object
    words: dict[str, float]  # of each span that no other token reads
    others: dict[str, float]  # of each other instruction
    restored: list[PatchingResult]
    moved_mm: Moved | None = None  # None: this environment's actions are no distances

    @property
    def measured(self) -> "Moved | Explanation":
        """Effects as they are shown: in millimetres where these are known, else drops of the score."""
        return self.moved_mm or self

    @property
    def measured_unit(self) -> str:
        """Unit of `measured`."""
        return self.unit if self.moved_mm is None else "mm"

    @property
    def largest_patch(self) -> float:
        """Largest shown effect of a patch of any image: maps of one moment have one scale."""
        return max(float(map_GG.max()) for map_GG in self.measured.patches.values())

    @property
    def largest(self) -> float:
        """Largest shown effect of a patch, an object in all cameras, or a word hidden or changed."""
        shown = self.measured
        effects = (*shown.objects.get(ALL, {}).values(), *shown.words.values(), *shown.others.values())
        return max(self.largest_patch, *(effect for effect in effects if effect == effect), 0.0)

    def as_json(self) -> dict[str, Any]:
        """Return the explanation as JSON values; NaN becomes None."""
        moved = self.moved_mm
        values = vars(self) | {
            "patches": _lists(self.patches),
            "restored": [vars(each) for each in self.restored],
            "moved_mm": None if moved is None else vars(moved) | {"patches": _lists(moved.patches)},
        }
        return finite(values)


def _lists(maps: Mapping[str, Tensor]) -> dict[str, Any]:
    return {key: map_GG.tolist() for key, map_GG in maps.items()}


def finite(value: Any) -> Any:
    """Return JSON values with None in place of NaN."""
    if isinstance(value, dict):
        return {key: finite(each) for key, each in value.items()}
    if isinstance(value, list):
        return [finite(each) for each in value]
    return None if isinstance(value, float) and value != value else value


def explain(question: Question, query: MomentQuery, actions: NextActions | None = None) -> Explanation:
    """Measure all effects of a query; with ``actions`` also in millimetres.

    Raises:
        ValueError: the grid does not divide an image, or as `filling`.
    """
    fillings = {key: _filling(question, query, key) for key in image_keys(question)}
    patches = {key: _patches(question, query.grid, key, each) for key, each in fillings.items()}
    words = _words(question, query)
    others = _others(question, query)
    corrupted = corruptions(question, query, fillings, patches, words, others)
    return Explanation(
        unit=question.policy.unit,
        clean_score=question.clean_score,
        patches=patches,
        objects=_objects(question, query, fillings),
        words=words,
        others=others,
        restored=[restore(question, query, each, actions) for each in corrupted],
        moved_mm=None if actions is None else _moved(question, query, fillings, actions),
    )


def _moved(
    question: Question, query: MomentQuery, fillings: Mapping[str, Tensor], actions: NextActions
) -> Moved:
    """Measure the effects of the same changes on the next actions."""
    objects: dict[str, dict[str, float]] = {}
    for key, name, changed in _without_objects(question, query, fillings):
        objects.setdefault(key, {})[name] = actions.moved_mm(changed)
    patches = {}
    for key, filled in fillings.items():
        masks = patch_masks(query.grid, *filled.shape[1:]).to(filled.device)
        (image,) = question.observation[key]
        moved = [actions.moved_mm({key: each[None]}) for each in occluded(image, masks, filled)]
        patches[key] = torch.tensor(moved).unflatten(0, (query.grid, query.grid))
    return Moved(
        patches,
        objects,
        {span.name: actions.moved_mm({}, span.tokens(query.offsets)) for span in query.spans},
        {name: actions.moved_mm({"task": [other]}) for name, other in query.others.items()},
    )


def image_keys(question: Question) -> list[str]:
    """Return the keys of the images that the policy sees."""
    return [
        key
        for key, value in sorted(question.observation.items())
        if key.startswith(OBS_IMAGE) and isinstance(value, Tensor) and value.ndim == 4
    ]


def _filling(question: Question, query: MomentQuery, key: str) -> Tensor:
    (image,) = question.observation[key]
    blur_px = image.shape[-1] / query.grid / 2
    other = query.other_scene.get(key)
    return filling(image, query.fill, blur_px, None if other is None else other[0])


def _patches(question: Question, grid: int, key: str, filling_3HW: Tensor) -> Tensor:
    masks = patch_masks(grid, *filling_3HW.shape[1:]).to(filling_3HW.device)
    return question.effects_of_masks(key, masks, filling_3HW).unflatten(0, (grid, grid)).cpu()


def _without_objects(
    question: Question, query: MomentQuery, fillings: Mapping[str, Tensor]
) -> Iterator[tuple[str, str, Batch]]:
    """Yield (key or ALL, object, images) without each object that cameras show: in one camera, in all."""
    for name in dict.fromkeys(name for masks in query.objects.values() for name in masks):
        changed: Batch = {}
        for key, masks in query.objects.items():
            if masks[name].any():
                (image,) = question.observation[key]
                changed[key] = occluded(image, masks[name][None].to(image.device), fillings[key])
                yield key, name, {key: changed[key]}
        if changed:
            yield ALL, name, changed


def _objects(
    question: Question, query: MomentQuery, fillings: Mapping[str, Tensor]
) -> dict[str, dict[str, float]]:
    effects: dict[str, dict[str, float]] = {}
    for key, name, changed in _without_objects(question, query, fillings):
        effects.setdefault(key, {})[name] = float(question.effects_of_images(changed))
    return effects


def _words(question: Question, query: MomentQuery) -> dict[str, float]:
    if not query.spans:
        return {}
    hidden = torch.stack([span.tokens(query.offsets) for span in query.spans])
    effects = question.effects_of_hidden(hidden).tolist()
    return {span.name: effect for span, effect in zip(query.spans, effects, strict=True)}


def _others(question: Question, query: MomentQuery) -> dict[str, float]:
    if not query.others:
        return {}
    return dict(
        zip(query.others, question.effects_of_instructions([*query.others.values()]).tolist(), strict=True)
    )
