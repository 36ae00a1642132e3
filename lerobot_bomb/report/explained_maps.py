"""Effects over what the policy read: image patches and words in one colour scale; layers and heads."""

import re
from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from lerobot_bomb.explain.episode import ExplainedMoment
from lerobot_bomb.explain.limits import SMALLEST_MM, smallest_drop
from lerobot_bomb.explain.maps import STRENGTH, TINT_RGB, data_url, strength, tinted
from lerobot_bomb.explain.moment import OTHER_INSTRUCTION, OTHER_SCENE, WORDS, PatchingResult, camera_name
from lerobot_bomb.explain.spans import spans_of_words
from lerobot_bomb.report.chart import INK, Chart, draw

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SHOWN = "width:min(14rem,40vw)"  # of a picture: two beside each other on a phone
PANEL_INCHES = 1.9
# of corruptions: rows of the figure
KINDS = ("hidden patch", "hidden words", "other words", "other scene")


def maps_html(moments: Sequence[ExplainedMoment]) -> str:
    """Return images and words of each moment, tinted by their effects, all in one scale."""
    largest = max(map(_largest, moments))
    figures = "".join(_moment(each, largest) for each in moments)
    grid = f'<div style="display:flex;flex-wrap:wrap;gap:1rem;align-items:start">{figures}</div>'
    return f"{_scale(moments[0], largest)}{grid}"


def _largest(moment: ExplainedMoment) -> float:
    found = moment.explanation
    words = [effect for name, effect in found.measured.words.items() if name.startswith('"')]
    return max([found.largest_patch, *words])


def _scale(moment: ExplainedMoment, largest: float) -> str:
    unit = moment.explanation.measured_unit
    what = (
        "how far the next action moves when the patch or word is hidden"
        if unit == "mm"
        else "how far the score of the policy's answer drops when the patch or word is hidden"
    )
    shades = f"linear-gradient(90deg,transparent,rgba{(*TINT_RGB, STRENGTH)})"
    look = f"display:inline-block;width:9rem;height:.9em;border:1px solid #8888;background:{shades}"
    top = f"{largest:.3g} {escape(unit)}"
    return f'<p class="note">0 <span style="{look}"></span> {top}: {what}. One scale for all.</p>'


def _moment(moment: ExplainedMoment, largest: float) -> str:
    patches = moment.explanation.measured.patches
    images = "".join(
        f'<img src="{data_url(tinted(patches[key].numpy(), largest, image))}" style="width:100%" '
        f'alt="{escape(f"{camera_name(key)} at {moment.title}, tinted by the effects of its patches")}">'
        f"<div>{escape(camera_name(key))}</div>"
        for key, image in moment.images.items()
    )
    does = f"<div>it {escape(moment.snapshot.does)}</div>" if moment.snapshot.does else ""
    caption = f"<figcaption>{escape(moment.title)}</figcaption>{does}"
    return f'<figure style="margin:0;{SHOWN}">{caption}{images}{_words(moment, largest)}</figure>'


def _words(moment: ExplainedMoment, largest: float) -> str:
    """Return the instruction, each word tinted by its effect; the effect beside those that matter."""
    found = moment.explanation
    effects = found.measured.words
    if not effects:
        return ""
    smallest = SMALLEST_MM if found.moved_mm is not None else smallest_drop(found.clean_score)
    instruction, end, parts = moment.snapshot.instruction, 0, []
    for span in spans_of_words(instruction):
        first, last = span.ranges[0]
        effect = effects.get(f'"{span.name}"', 0.0)
        text = f"{effect:.2g} {found.measured_unit}"
        beside = f"<sup>{effect:.2g}</sup>" if effect > smallest else ""
        style = f"background:rgba{(*TINT_RGB, round(strength(effect, largest), 3))}"
        word = (
            f'<span style="{style}" title="{escape(text)}">{escape(instruction[first:last])}</span>{beside}'
        )
        parts += [escape(instruction[end:first]), word]
        end = last
    return f"<p>{''.join(parts)}{escape(instruction[end:])}</p>"


def heads_chart(moments: Sequence[ExplainedMoment]) -> Chart | None:
    """Draw what each head and MLP brings back: moments side by side, corruptions below each other."""
    kinds = [kind for kind in KINDS if any(_restored(each, kind) for each in moments)]
    if not kinds:
        return None
    title = "What single heads and MLPs bring back"

    def paint(figure: "Figure") -> None:
        grid = figure.subplots(len(kinds), len(moments), squeeze=False)
        for row, kind in enumerate(kinds):
            for column, moment in enumerate(moments):
                _paint_heads(grid[row][column], _restored(moment, kind))
                if row == 0:
                    grid[row][column].set_title(moment.title)
            grid[row][0].set_ylabel(f"{kind}\nlayer")
        for axes in grid[-1]:
            axes.set_xlabel("heads, then MLP")

    note = (
        "After an input is changed, the clean output of one head or MLP is put back. Darkest: the whole drop "
        "of the answer's score comes back; empty: none of it, or there was no drop."
    )
    size = (1.2 + PANEL_INCHES * len(moments), 0.5 + 1.4 * len(kinds))
    return Chart(title, draw(title, size, paint), [], note)


def _restored(moment: ExplainedMoment, kind: str) -> PatchingResult | None:
    return next((each for each in moment.explanation.restored if _kind(each.corruption) == kind), None)


def _kind(corruption: str) -> str:
    if corruption == OTHER_SCENE:
        return KINDS[3]
    if corruption.startswith(OTHER_INSTRUCTION):
        return KINDS[2]
    return KINDS[1] if re.match(rf"{WORDS}\b", corruption) else KINDS[0]


def _paint_heads(axes: "Axes", restored: PatchingResult | None) -> None:
    axes.set_xticks([])
    if restored is None:
        axes.set_axis_off()
        return
    num_heads = max(len(heads) for heads in restored.heads)
    ratios = np.zeros((len(restored.heads), num_heads + 1))
    for layer, (heads, mlp) in enumerate(zip(restored.heads, restored.mlps, strict=True)):
        ratios[layer, : len(heads)] = heads
        ratios[layer, num_heads] = mlp
    shades = np.zeros((*ratios.shape, 4))
    shades[..., :3] = np.array(TINT_RGB) / 255
    shades[..., 3] = np.clip(np.nan_to_num(ratios), 0, 1)
    axes.imshow(shades, aspect="auto", interpolation="nearest")
    axes.axvline(num_heads - 0.5, color=INK, linewidth=0.6)
    layers = sorted({0, len(ratios) - 1})
    axes.set_yticks(layers, [str(layer) for layer in layers])
