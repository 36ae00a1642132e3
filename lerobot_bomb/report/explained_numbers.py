"""Tables of all numbers of an explained moment, for those who want them."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from lerobot_bomb.explain.episode import ExplainedMoment
from lerobot_bomb.explain.following import Following
from lerobot_bomb.explain.moment import Explanation
from lerobot_bomb.explain.moment_query import camera_name
from lerobot_bomb.explain.patching import PatchingResult
from lerobot_bomb.report.explained_pointing import pointing_tables
from lerobot_bomb.report.table import Cell, Table

QUESTIONS = ["question", "answer"]
FOLLOWING_COLUMNS = ["asked, mm", "moved, mm", "towards it, mm"]
FOLLOWING_NOTE = (
    "Of the actions that are executed before the policy looks again: from target to other target, from where "
    "they lead to where they lead then, and how far of that towards the other target."
)


def numbers_tables(moment: ExplainedMoment, largest: float) -> list[Table]:
    """Return the tables of one moment; effects are shaded up to `largest`."""
    explanation = moment.explanation
    findings = [[Cell(each.question), Cell(each.answer)] for each in moment.findings]
    tables = [Table("What the score of the answer depends on", QUESTIONS, findings)]
    tables += [] if moment.pointing is None else [*pointing_tables(moment.pointing)]
    tables += _objects(explanation, largest)
    tables += _words(explanation, largest)
    if moment.followings:
        tables.append(_followings(moment.followings))
    for restored in explanation.restored:
        tables += _restored(restored)
    return [replace(each, title=f"{moment.title}: {each.title}") for each in tables]


def effects_note(explanation: Explanation) -> str:
    """Say what the columns of effects are."""
    return (
        f"moved: how far the next action moves. drop: by how much the score of the clean answer drops; it is "
        f"{explanation.clean_score:.4g} ({explanation.unit}) with nothing changed. Negative: it rises."
    )


def _objects(explanation: Explanation, largest: float) -> list[Table]:
    note, moved = effects_note(explanation), explanation.moved_mm
    return [
        _effects(
            f"Objects taken out: {camera_name(key)}",
            "object",
            effects,
            {} if moved is None else moved.objects[key],
            note,
            largest,
        )
        for key, effects in explanation.objects.items()
    ]


def _words(explanation: Explanation, largest: float) -> list[Table]:
    note, moved = effects_note(explanation), explanation.moved_mm
    of_words = (
        f"{note} In quotes: single words, (2) where one stands for the second time; else what is named."
    )
    tables = []
    if explanation.words:
        mm = {} if moved is None else moved.words
        tables.append(
            _effects("Words left out of the attention", "words", explanation.words, mm, of_words, largest)
        )
    if explanation.others:
        mm = {} if moved is None else moved.others
        tables.append(_effects("Words changed", "what is changed", explanation.others, mm, note, largest))
    return tables


def _effects(
    title: str,
    column: str,
    drops: Mapping[str, float],
    moved_mm: Mapping[str, float],
    note: str,
    largest: float,
) -> Table:
    shown = moved_mm or drops
    rows = []
    for name in sorted(drops, key=lambda name: -shown[name]):
        shade = min(max(0.0, shown[name]) / (largest or 1.0), 1.0)
        drop = Cell(f"{drops[name]:.4f}", drops[name], None if moved_mm else shade)
        moved = [Cell(f"{moved_mm[name]:.1f}", moved_mm[name], shade)] if moved_mm else []
        rows.append([Cell(name), *moved, drop])
    return Table(title, [column, *(["moved, mm"] if moved_mm else []), "drop"], rows, note)


def _followings(followings: Mapping[str, Following]) -> Table:
    rows = [
        [
            Cell(word),
            Cell(each.instruction),
            Cell(f"{each.asked_mm:.0f}", each.asked_mm),
            Cell(f"{each.moved_mm:.1f}", each.moved_mm),
            Cell("-" if np.isnan(each.along_mm) else f"{each.along_mm:.1f}", each.along_mm),
        ]
        for word, each in followings.items()
    ]
    header = ["changed", "instruction", *FOLLOWING_COLUMNS]
    return Table("Do the next actions follow?", header, rows, FOLLOWING_NOTE)


def _restored(restored: PatchingResult) -> list[Table]:
    title = f"Restored after: {restored.corruption}"
    far = "" if restored.moved_mm is None else f"The next action moves {restored.moved_mm:.1f} mm. "
    drop = f"The score drops by {restored.drop:.4g}."
    note = f"{far}{drop} 1: all of that comes back, 0: none; -: it did not change."
    num_layers = len(restored.mlps)
    layers = [f"layer {layer}" for layer in range(num_layers)]
    tables = []
    if restored.places:
        rows = [[Cell(name), *map(_ratio, ratios)] for name, ratios in restored.places.items()]
        tables.append(Table(f"{title}; states of layers, by tokens", ["tokens", *layers], rows, note))
    num_heads = max(len(heads) for heads in restored.heads)
    rows = [
        [Cell(name), *map(_ratio, heads), _ratio(mlp)]
        for name, heads, mlp in zip(layers, restored.heads, restored.mlps, strict=True)
    ]
    header = ["layer", *(f"head {head}" for head in range(num_heads)), "MLP"]
    return [*tables, Table(f"{title}; heads and MLPs", header, rows, note)]


def _ratio(value: float) -> Cell:
    if value != value:
        return Cell("-")
    return Cell(f"{value:.2f}", value, float(np.clip(value, 0, 1)))
