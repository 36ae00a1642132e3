"""Tables and pictures of a policy's pointing, for the page of an explanation."""

from collections.abc import Iterator, Sequence
from html import escape

import numpy as np

from lerobot_bomb.bomb.move import place_name
from lerobot_bomb.explain.aggregate import Mean, mean_of
from lerobot_bomb.explain.episode import ExplainedMoment
from lerobot_bomb.explain.film import CAMERA
from lerobot_bomb.explain.maps import data_url
from lerobot_bomb.explain.moment_query import camera_name
from lerobot_bomb.explain.pointing import MARKED_PX, PointingCheck, marked
from lerobot_bomb.report.cells import mean_cell
from lerobot_bomb.report.table import Cell, Table

NUM_PLACES = 5  # of the likeliest, that are shown
LEAST_SHARE = 0.01
NOTE = (
    "What is meant is what the expert would be about here; its action is the one for what is pointed at. It "
    "goes there if that and the next action lead to within 5 mm of each other, or half the expert's way."
)


def pointing_tables(check: PointingCheck) -> Iterator[Table]:
    """Yield tables of predicted and true stone, place and next action; and of the likeliest places."""
    pointed, meant = check.pointed, check.meant
    stones_mm = 1e3 * pointed.stone_xy, 1e3 * meant.stone_xy
    rows = [
        [Cell("place"), Cell(check.place), Cell(check.meant_place), _millimetres(check.place_mm)],
        [Cell("stone, mm"), *map(_xy, stones_mm), _millimetres(check.stone_mm)],
        [Cell("next action, mm"), *map(_xy, (check.way_mm, check.asked_mm)), _millimetres(check.apart_mm)],
    ]
    if pointed.held is not None:
        held = [Cell(f"{share:.2f}", share) for share in (pointed.held, meant.held)]
        rows.insert(2, [Cell("held"), *held, Cell("-")])
    note = f"It points at {check.finding.answer}. {NOTE}"
    yield Table("What it points at", ["what", "policy", "meant", "apart, mm"], rows, note)
    likeliest = pointed.likeliest[:NUM_PLACES]
    if likeliest:
        places = [
            [Cell(place_name(np.array(xy))), Cell(f"{share:.2f}", share, share)]
            for xy, share in likeliest
            if share >= LEAST_SHARE
        ]
        yield Table("The likeliest places", ["place", "probability"], places)


def pointing_figure(moment: ExplainedMoment) -> str:
    """Return HTML of the camera's image with marks; empty without image or marks."""
    image = next((each for key, each in moment.images.items() if camera_name(key) == CAMERA), None)
    if moment.pointing is None or image is None:
        return ""
    shown = marked(image, moment.snapshot.cameras[CAMERA], moment.pointing.marks)
    caption = (
        f"{CAMERA}: rings where it points, crosses where that is; orange: the place "
        f"({moment.pointing.meant_place} is meant), blue: the stone"
    )
    size = f'width="{MARKED_PX}" height="{MARKED_PX}"'
    tag = f'<img src="{data_url(shown)}" {size} alt="{escape(caption)}">'
    return f"<figure>{tag}<figcaption>{escape(caption)}</figcaption></figure>"


def mean_shares(moments: Sequence[ExplainedMoment]) -> dict[str, Mean]:
    """Return how often pointing is right, and how often the next action goes there; {}: it does not point."""
    checks = [each.pointing for each in moments if each.pointing is not None]
    shares = {
        "the place that is meant": [check.is_place_right for check in checks],
        "the stone that is meant": [check.is_stone_right for check in checks],
        "the next action goes there": [check.goes_there for check in checks],
        "goes there, of those that point at the place": [
            check.goes_there for check in checks if check.is_place_right
        ],
    }
    means = {name: mean_of([*map(float, values)]) for name, values in shares.items()}
    return {name: mean for name, mean in means.items() if mean is not None}


def mean_pointing(moments: Sequence[ExplainedMoment]) -> Iterator[Table]:
    """Yield a table of how often pointing is right, its error, and how often the next action goes there."""
    checks = [each.pointing for each in moments if each.pointing is not None]
    if not checks:
        return
    distances = {
        "from the place, mm": [check.place_mm for check in checks],
        "from the stone, mm": [check.stone_mm for check in checks],
    }
    rows = [[Cell(name), mean_cell(mean, ".2f")] for name, mean in mean_shares(moments).items()]
    rows += [[Cell(name), mean_cell(mean_of(values), ".1f")] for name, values in distances.items()]
    yield Table("What it points at", ["what", "share or mean"], rows, NOTE)


def _millimetres(value: float) -> Cell:
    return Cell(f"{value:.1f}", value)


def _xy(values: np.ndarray) -> Cell:
    x, y = values.tolist()
    return Cell(f"x {x:.0f}, y {y:.0f}", [x, y])
