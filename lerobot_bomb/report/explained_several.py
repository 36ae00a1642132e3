"""Explanations of several episodes as a page: means with intervals, phase by phase."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from lerobot_bomb.explain.aggregate import Mean, mean_of, means_of
from lerobot_bomb.explain.episode import ExplainedMoment
from lerobot_bomb.explain.limits import ALL
from lerobot_bomb.explain.probes import LayerProbe
from lerobot_bomb.report.cells import mean_cell
from lerobot_bomb.report.explained_means import (
    MIDDLE,
    effects_chart,
    following_charts,
    largest_mean,
    mean_maps_html,
    pointing_charts,
    probes_chart,
)
from lerobot_bomb.report.explained_numbers import FOLLOWING_COLUMNS, FOLLOWING_NOTE
from lerobot_bomb.report.explained_pointing import mean_pointing
from lerobot_bomb.report.explanation import verdict_section
from lerobot_bomb.report.table import Cell, Section, Table


def aggregate_sections(
    sentences: Sequence[str], by_phase: Mapping[str, Sequence[ExplainedMoment]], command: str
) -> list[Section]:
    """Write the sections of several episodes: the verdict, then the numbers of each phase."""
    values = {phase: [each.as_json() for each in moments] for phase, moments in by_phase.items()}
    largest = largest_mean(by_phase)
    charts = [effects_chart(values), *following_charts(by_phase), *pointing_charts(by_phase)]
    sections = [
        verdict_section(sentences, ""),
        Section("Effects", [], charts=charts),
        Section("Where in the image", [], [], mean_maps_html(by_phase, largest)),
    ]
    tables = [
        replace(table, title=f"{phase.capitalize() or MIDDLE}, {len(moments)} episodes: {table.title}")
        for phase, moments in by_phase.items()
        for table in _mean_tables(moments)
    ]
    return [*sections, Section("All numbers", tables, [command], is_folded=True)]


def _mean_tables(moments: Sequence[ExplainedMoment]) -> Iterator[Table]:
    explanations = [each.explanation for each in moments]
    unit = explanations[0].measured_unit
    what = "Mean way that the next action moves, mm" if unit == "mm" else f"Mean drop of the score ({unit})"
    note = f"{what}, with its 95 % bootstrap interval over {len(moments)} episodes."
    form = ".1f" if unit == "mm" else ".4f"
    measured = [each.measured for each in explanations]
    # single words differ from one instruction to the next
    words = [{name: each.words[name] for name in each.words if name[0] != '"'} for each in measured]
    for title, column, effects in (
        ("Objects taken out of all images", "object", [each.objects.get(ALL, {}) for each in measured]),
        ("Words left out of the attention", "words", words),
        ("Words changed", "what is changed", [each.others for each in measured]),
    ):
        if found := means_of(effects):
            yield _means(title, column, found, form, note)
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
    header = ["what", "states", "held out", "floor", "episodes held out"]
    chart = probes_chart(probes, Table("", header, rows))
    return Section("Where is the destination known?", [], charts=[chart])


def _means(title: str, column: str, means: Mapping[str, Mean], form: str, note: str) -> Table:
    largest = max((abs(mean.value) for mean in means.values()), default=0.0) or 1.0
    rows = [
        [
            Cell(name),
            mean_cell(mean, form, max(0.0, mean.value) / largest),
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
