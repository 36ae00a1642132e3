"""Explanation of one episode as a page: the verdict, what happened, what it depends on; then all numbers."""

from collections.abc import Mapping, Sequence
from html import escape

from lerobot_bomb.bomb.judge import is_off_board
from lerobot_bomb.explain.counterfactuals import Counterfactual, settled_by
from lerobot_bomb.explain.episode import ExplainedMoment
from lerobot_bomb.explain.facts import turning
from lerobot_bomb.explain.film import EpisodeRun
from lerobot_bomb.explain.mask_names import change
from lerobot_bomb.report.explained_film import counterfactual_html, paths_chart
from lerobot_bomb.report.explained_maps import heads_section, largest_effect, maps_html
from lerobot_bomb.report.explained_numbers import numbers_tables
from lerobot_bomb.report.explained_pointing import pointing_figure
from lerobot_bomb.report.table import Cell, Section, Table

OUTCOME = ["outcome", "steps", "nearest intersection", "from the target, mm"]


def verdict_section(sentences: Sequence[str], instruction: str) -> Section:
    """Write the section that answers: the instruction, then the verdict, sentence by sentence."""
    told = [f"<p><q>{escape(instruction)}</q></p>"] if instruction else []
    first, *rest = map(escape, sentences)
    told += [
        f'<p class="statement"><b>{first}</b></p>',
        *(f'<p class="statement">{each}</p>' for each in rest),
    ]
    return Section("Verdict", [], [], "\n".join(told))


def episode_sections(
    sentences: Sequence[str],
    moments: Sequence[ExplainedMoment],
    run: EpisodeRun,
    masked: Mapping[str, EpisodeRun],
    counterfactuals: Sequence[Counterfactual],
    command: str,
) -> list[Section]:
    """Write the sections of one episode; ``masked``: the first has no mask."""
    snapshot = moments[0].snapshot
    state = snapshot.state
    target_xy = None if state is None else state.goals[0].xyz[:2].tolist()
    heads = heads_section(moments)
    sections = [
        verdict_section(sentences, snapshot.instruction),
        _happened(run, masked, counterfactuals, target_xy),
        Section("What the next action depends on", [], [], maps_html(moments) + _pointing(moments)),
        *([] if heads is None else [heads]),
        *([_masked(masked, target_xy)] if masked else []),
    ]
    largest = largest_effect(moments)
    tables = [table for each in moments for table in numbers_tables(each, largest)]
    lines = [*_not_asked(moments[0]), command]
    return [*sections, Section("All numbers", tables, lines, is_folded=True)]


def _pointing(moments: Sequence[ExplainedMoment]) -> str:
    figures = "".join(map(pointing_figure, moments))
    return (
        f'<h3>Where it points</h3><div style="display:flex;flex-wrap:wrap;gap:1rem">{figures}</div>'
        if figures
        else ""
    )


def _happened(
    run: EpisodeRun,
    masked: Mapping[str, EpisodeRun],
    counterfactuals: Sequence[Counterfactual],
    target_xy: Sequence[float] | None,
) -> Section:
    """Write filmstrips and paths of the episode and of the runs that settle it."""
    settled = settled_by(counterfactuals)
    charts = []
    if len(run.gripper_xyz):
        runs = {"this episode": run} | ({} if settled is None else {settled.name: settled.run})
        runs |= _turned(run, masked)
        charts = [paths_chart("Paths over the board", runs, target_xy)]
    tables = []
    if counterfactuals:
        runs = {"this episode": run} | {each.name: each.run for each in counterfactuals}
        rows = [[Cell(name), *_outcome(each)] for name, each in runs.items()]
        tables = [Table("The same seed under fewer perturbations", ["episode", *OUTCOME], rows)]
    return Section("What happened", tables, [], counterfactual_html(run, settled), charts=charts)


def _turned(run: EpisodeRun, masked: Mapping[str, EpisodeRun]) -> dict[str, EpisodeRun]:
    """Return the first run under a mask that the verdict names: one that succeeds, or ends at the target."""
    outcomes = {name: each.result.as_json() for name, each in masked.items()}
    succeeded, right = turning(run.result.as_json(), outcomes)
    return {change(name): masked[name] for name in [*succeeded, *right][:1]}


def _outcome(run: EpisodeRun) -> list[Cell]:
    result = run.result
    outcome = "success" if result.is_success else f"failed: {result.failure}"
    if not hasattr(result, "nearest_intersection"):
        return [Cell(outcome), Cell("-"), Cell("-"), Cell("-")]
    row, column = result.nearest_intersection
    error_mm = result.placement_error_mm
    is_off = is_off_board(run.stone_xyz[-1, :2])
    return [
        Cell(outcome),
        Cell(str(result.steps), result.steps),
        Cell("off the board" if is_off else f"row {row}, column {column}"),
        Cell(f"{error_mm:.1f}", error_mm),
    ]


def _masked(masked: Mapping[str, EpisodeRun], target_xy: Sequence[float] | None) -> Section:
    """Write what becomes of the episode if something is hidden or reworded in every step."""
    named = {change(name): run for name, run in masked.items()}
    rows = [[Cell(name), *_outcome(run)] for name, run in named.items()]
    note = (
        "The same episode, with the same random numbers, each with something hidden, or another word named, "
        "in every step. The board's left half holds column 0, its far half row 0."
    )
    table = Table("What became of the stone", ["given to the policy", *OUTCOME], rows, note)
    chart = paths_chart("Paths under masks", named, target_xy)
    figure = f'<figure><div class="wide" tabindex="0">{chart.svg}</div></figure>'
    drawn = f"<details><summary>{escape(chart.title)}</summary>{figure}</details>"
    return Section("With something hidden or reworded", [table], [], drawn, is_folded=True)


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
