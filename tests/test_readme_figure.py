"""The README's first figure."""

import runpy
from pathlib import Path

MEDIA = Path(__file__).parents[1] / "docs" / "media"


def test_the_committed_figure_is_what_the_report_draws_from_the_committed_records() -> None:
    drawn = runpy.run_path(str(MEDIA / "robustness.py"))
    assert drawn["figure"]() == drawn["FIGURE"].read_text()
