r"""Draws the README's first figure as `report` draws it: `python docs/media/robustness.py`.

Its records, without the folder of the package:

lerobot-bomb sweep outputs/shipped --policies=bomb:vla0_smol,bomb:spatialvla_grid,bomb:fdvla \
    --env.type=bomb --env.perturbations=none,each:3,all:3 --policy.device=cpu --episodes=50
sed 's#"[^"]*/lerobot_bomb/#"lerobot_bomb/#' outputs/shipped/results.jsonl |
    gzip -9n > docs/media/shipped.jsonl.gz
"""

import gzip
import tempfile
from pathlib import Path

from lerobot_bomb.commands.results_files import read_undamaged
from lerobot_bomb.report.chart import standalone
from lerobot_bomb.report.report import Report
from lerobot_bomb.report.sections import answer
from lerobot_bomb.results.groups import groups_of

MEDIA = Path(__file__).parent
RECORDS, FIGURE = MEDIA / "shipped.jsonl.gz", MEDIA / "robustness.svg"


def figure() -> str:
    """Return the figure as SVG."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "shipped.jsonl"
        path.write_bytes(gzip.decompress(RECORDS.read_bytes()))
        groups = groups_of(read_undamaged(path).records)
    (chart,) = answer.section(Report(groups)).charts
    return standalone(chart.svg)


if __name__ == "__main__":
    FIGURE.write_text(figure())
