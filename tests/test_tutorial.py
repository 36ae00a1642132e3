"""The notebook `docs/tutorial.ipynb` runs from top to bottom, and what it trains gets better."""

import json
import os
import sys
from collections import defaultdict
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOK = Path(__file__).parents[1] / "docs" / "tutorial.ipynb"
CELL_TIMEOUT_S = 1800


@pytest.mark.long
def test_the_tutorial_runs_from_top_to_bottom(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    NotebookClient(
        notebook, timeout=CELL_TIMEOUT_S, resources={"metadata": {"path": str(tmp_path)}}
    ).execute()
    successes = defaultdict(list)
    for line in (tmp_path / "tutorial" / "learned" / "results.jsonl").read_text().splitlines():
        record = json.loads(line)
        successes[record["policy"]["path"]].append(record["is_success"])
    early, late = (sum(successes[path]) for path in sorted(successes))
    assert early < late and late >= 18  # of 20
