"""Explanations as sections of a page."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from lerobot_bomb.bomb.board import BOARD
from lerobot_bomb.explain.aggregate import Mean, mean_of, means_of
from lerobot_bomb.explain.episode import ExplainedMoment
from lerobot_bomb.explain.following import Following
from lerobot_bomb.explain.maps import cells, data_url, overlay
from lerobot_bomb.explain.masked_episodes import MaskedEpisode
from lerobot_bomb.explain.moment import ALL, PatchingResult, camera_name
from lerobot_bomb.explain.probes import LayerProbe
from lerobot_bomb.report.cells import mean_cell
from lerobot_bomb.report.explained_pointing import mean_pointing, pointing_figure, pointing_tables
from lerobot_bomb.report.table import Cell, Section, Table
from lerobot_bomb.results.summary import named_counts
from lerobot_bomb.stats import format_rate

QUESTIONS = ["question", "answer"]
MIDDLE = "The middle of the episode"
FOLLOWING_COLUMNS = ["asked, mm", "moved, mm", "towards it, mm"]
FOLLOWING_NOTE = (
    "Of the actions that are executed before the policy looks again: from target to other target, from where "
    "they lead to where they lead then, and how far of that towards the other target."
)
SHOWN_PX = 224  # side of an image on the page
# of masked episodes, distinct for the colour-blind (Okabe and Ito); used again with dashes
TRACE_COLORS = ("#e69f00", "#56b4e9", "#009e73", "#d55e00", "#0072b2", "#cc79a7", "#999999")
TRACE_DASHES = ("none", "6 3", "2 2", "8 2 2 2")
TRACE_SIZE = 420  # pixels of the plot's side
LEGEND_WIDTH = 220  # pixels, beside it
LEGEND_LINE_PX = 26  # of each trace, before its name
TRACE_RANGE_M = 0.24  # either way from the board's centre


def overview_section(outcome: str, moments: Sequence[ExplainedMoment], command: str) -> Section:
    """Write the section of instruction, outcome, and findings of each moment."""
    found = [
        Table(
            each.title,
            QUESTIONS,
            [[Cell(finding.question), Cell(finding.answer)] for finding in each.findings],
        )
        for each in moments
    ]
    told = "\n".join([moments[0].snapshot.instruction, outcome])
    return Section("In short", found, [*_not_asked(moments[0]), command], f"<pre>{escape(told)}</pre>")


def _not_asked(moment: ExplainedMoment) -> list[str]:
    """Return a line for each kind of question that cannot be asked of this policy."""
    explanation = moment.explanation
    is_missing = {
        "Words: none are hidden, for this policy reads no instruction.": not explanation.words,
        "Layers, heads and MLPs: none are put back, for no language model of this policy is known.": (
            not explanation.restored
        ),
        "Layers by tokens: none are put back, for this policy calls the parts of its layers one by one.": (
            bool(explanation.restored) and not any(each.places for each in explanation.restored)
        ),
    }
    return [line for line, missing in is_missing.items() if missing]


def moment_sections(moment: ExplainedMoment) -> list[Section]:
    """Write the section of one moment: maps of patches, effects of objects and words, what is restored."""
    explanation = moment.explanation
    note = (
        f"By how much the score of the clean answer drops; it is {explanation.clean_score:.4g} "
        f"({explanation.unit}) with nothing changed. Negative: it rises."
    )
    of_words = (
        f"{note} In quotes: single words, (2) where one stands for the second time; else what is named."
    )
    tables = [] if moment.pointing is None else [*pointing_tables(moment.pointing)]
    tables += [
        _effects(f"Objects taken out: {camera_name(key)}", "object", each, note)
        for key, each in explanation.objects.items()
    ]
    if explanation.words:
        tables.append(_effects("Words left out of the attention", "words", explanation.words, of_words))
    if explanation.others:
        tables.append(_effects("Words changed", "what is changed", explanation.others, note))
    if moment.followings:
        tables.append(_followings(moment.followings))
    for restored in explanation.restored:
        tables += _restored(restored)
    largest = explanation.largest_patch
    figures = pointing_figure(moment) + "".join(
        _figure(key, image, explanation.patches[key].numpy(), largest) for key, image in moment.images.items()
    )
    figures += f'<p class="note">Dark: no effect or a negative one; bright: {largest:.4g}.</p>'
    title = moment.title.capitalize()
    return [Section(title, tables, [moment.snapshot.instruction], f'<div class="wide">{figures}</div>')]


def aggregate_sections(
    results: Sequence[Any], by_phase: Mapping[str, Sequence[ExplainedMoment]], command: str
) -> list[Section]:
    """Write the sections of many episodes, by phase."""
    num_successes = sum(result.is_success for result in results)
    failures = Counter(result.failure for result in results if not result.is_success)
    reached = [[Cell(phase or MIDDLE), Cell(str(len(each)), len(each))] for phase, each in by_phase.items()]
    lines = [f"success: {format_rate(num_successes, len(results))}", f"failures: {named_counts(failures)}"]
    tables = [Table("Episodes that came to a phase", ["phase", "episodes"], reached)]
    sections = [Section("In short", tables, [*lines, command])]
    for phase, moments in by_phase.items():
        sections.append(Section(f"Phase: {phase}" if phase else MIDDLE, [*_mean_tables(moments)]))
    return sections


def _mean_tables(moments: Sequence[ExplainedMoment]) -> Iterator[Table]:
    explanations = [each.explanation for each in moments]
    note = (
        f"Mean drop of the score ({explanations[0].unit}), with its 95 % bootstrap interval over "
        f"{len(moments)} episodes."
    )
    # single words differ from one instruction to the next
    words = [{name: each.words[name] for name in each.words if name[0] != '"'} for each in explanations]
    for title, column, effects in (
        ("Objects taken out of all images", "object", [each.objects.get(ALL, {}) for each in explanations]),
        ("Words left out of the attention", "words", words),
        ("Words changed", "what is changed", [each.others for each in explanations]),
    ):
        if found := means_of(effects):
            yield _means(title, column, found, note)
    yield from mean_pointing(moments)
    if any(each.followings for each in moments):
        yield _mean_followings(moments)


def probes_section(probes: Sequence[LayerProbe]) -> Section:
    """Write the section of probes of the layers' states."""
    rows = [
        [
            Cell(each.what),
            Cell(f"{each.place}, layer {each.layer}"),
            Cell(f"{each.probe.score:.2f}", each.probe.score, float(np.clip(each.probe.score, 0, 1))),
            Cell(f"{each.probe.floor:.2f}", each.probe.floor),
            Cell(str(each.probe.num_held_out), each.probe.num_held_out),
        ]
        for each in probes
    ]
    note = (
        "Linear probes of each layer's states, means over tokens, in the first moment that is asked about. "
        "Row and column: share of held-out episodes that are right; stone: share of variance explained; "
        "floor: the same with shuffled labels."
    )
    header = ["what", "states", "held out", "floor", "episodes held out"]
    return Section("Where is the destination known?", [Table("Probes", header, rows, note)])


def _means(title: str, column: str, means: Mapping[str, Mean], note: str) -> Table:
    largest = max((abs(mean.value) for mean in means.values()), default=0.0) or 1.0
    rows = [
        [
            Cell(name),
            mean_cell(mean, ".4f", max(0.0, mean.value) / largest),
            Cell(str(mean.num_episodes), mean.num_episodes),
        ]
        for name, mean in sorted(means.items(), key=lambda pair: -pair[1].value)
    ]
    return Table(title, [column, "effect", "episodes"], rows, note)


def _mean_followings(moments: Sequence[ExplainedMoment]) -> Table:
    words = list(dict.fromkeys(word for each in moments for word in each.followings))
    rows = []
    for word in words:
        found = [each.followings[word] for each in moments if word in each.followings]
        values = [[getattr(each, name) for each in found] for name in ("asked_mm", "moved_mm", "along_mm")]
        rows.append([Cell(word), *(mean_cell(mean_of(each), ".1f") for each in values)])
    return Table("Do the next actions follow?", ["changed", *FOLLOWING_COLUMNS], rows, FOLLOWING_NOTE)


def _effects(title: str, column: str, effects: Mapping[str, float], note: str) -> Table:
    largest = max((abs(effect) for effect in effects.values()), default=0.0) or 1.0
    rows = [
        [Cell(name), Cell(f"{effect:.4f}", effect, max(0.0, effect) / largest)]
        for name, effect in sorted(effects.items(), key=lambda pair: -pair[1])
    ]
    return Table(title, [column, "effect"], rows, note)


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
    note = f"The score drops by {restored.drop:.4g}. 1: all of that comes back, 0: none; -: it did not drop."
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
    header = ["", *(f"head {head}" for head in range(num_heads)), "MLP"]
    return [*tables, Table(f"{title}; heads and MLPs", header, rows, note)]


def _ratio(value: float) -> Cell:
    if value != value:
        return Cell("-")
    return Cell(f"{value:.2f}", value, float(np.clip(value, 0, 1)))


def traces_section(episodes: Mapping[str, MaskedEpisode]) -> Section:
    """Write the section of whole episodes under masks; the first has no mask."""
    rows = []
    for name, episode in episodes.items():
        result = episode.result
        row, column = result.nearest_intersection
        outcome = "success" if result.is_success else f"failed: {result.failure}"
        error = result.placement_error_mm
        rows.append(
            [Cell(name), Cell(outcome), Cell(f"row {row}, column {column}"), Cell(f"{error:.1f}", error)]
        )
    table = Table(
        "What became of the stone",
        ["hidden from the policy", "outcome", "nearest intersection", "from the target, mm"],
        rows,
        "The same episode, with the same random numbers, each with something hidden in every step.",
    )
    return Section("Whole episodes under a mask", [table], [], traces_svg(episodes))


def traces_svg(episodes: Mapping[str, MaskedEpisode]) -> str:
    """Draw the gripper's paths over the board from above: a line per episode, the first one thick."""

    def point(xy: np.ndarray) -> str:
        x, y = (xy[:2] * [1, -1] / TRACE_RANGE_M + 1) * TRACE_SIZE / 2
        return f"{x:.1f},{y:.1f}"

    lines = []
    last = BOARD.num_lines - 1
    for i in range(BOARD.num_lines):
        for start, end in (((i, 0), (i, last)), ((0, i), (last, i))):
            ends = " ".join(point(BOARD.intersection_xy(*intersection)) for intersection in (start, end))
            lines.append(f'<polyline points="{ends}" stroke="#8886" fill="none"/>')
    legend = []
    for i, (name, episode) in enumerate(episodes.items()):
        look = _trace_look(i)
        lines.append(f'<polyline points="{" ".join(map(point, episode.gripper_xyz))}" {look}/>')
        x, y = TRACE_SIZE + 8, 14 * (i + 1)
        legend.append(f'<line x1="{x}" x2="{x + LEGEND_LINE_PX}" y1="{y - 4}" y2="{y - 4}" {look}/>')
        at = f'x="{x + LEGEND_LINE_PX + 6}" y="{y}" font-size="12" fill="currentColor"'
        legend.append(f"<text {at}>{escape(name)}</text>")
    width = TRACE_SIZE + LEGEND_WIDTH
    size = f'viewBox="0 0 {width} {TRACE_SIZE}" width="{width}"'
    label = 'role="img" aria-label="Traces of the gripper from above"'
    return f'<div class="wide"><svg {size} {label}>{"".join(lines)}{"".join(legend)}</svg></div>'


def _trace_look(number: int) -> str:
    """Return the attributes of a trace's line; trace 0 is the one without a mask."""
    if number == 0:
        return 'stroke="currentColor" fill="none" stroke-width="3"'
    dashes, color = divmod(number - 1, len(TRACE_COLORS))
    dash = TRACE_DASHES[dashes % len(TRACE_DASHES)]
    return f'stroke="{TRACE_COLORS[color]}" fill="none" stroke-width="1.5" stroke-dasharray="{dash}"'


def _figure(key: str, image: np.ndarray, map_GG: np.ndarray, largest: float) -> str:
    """Return HTML of the image, the map cell by cell, and the map smoothed over the image."""
    shown = {
        "what is seen": image,
        "the effect of each patch": cells(map_GG, largest, *image.shape[:2]),
        "the same, smoothed over the image": overlay(map_GG, largest, image),
    }
    size = f'width="{SHOWN_PX}" height="{SHOWN_PX}"'
    tags = "".join(
        f'<img src="{data_url(each)}" {size} alt="{escape(f"{camera_name(key)}: {what}")}">'
        for what, each in shown.items()
    )
    return f"<figure>{tags}<figcaption>{escape(camera_name(key))}: {'; '.join(shown)}</figcaption></figure>"
