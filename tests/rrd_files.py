"""Recordings for Rerun's viewer, read back."""

from collections import defaultdict
from pathlib import Path
from typing import Any

type Logged = dict[str, dict[int | None, dict[str, Any]]]


def read_rrd(path: Path) -> Logged:
    """{entity: {step, or None where it is static: {component: values}}}."""
    from rerun.experimental import RrdReader

    logged: Logged = defaultdict(lambda: defaultdict(dict))
    for chunk in RrdReader(path).stream():
        columns = chunk.to_record_batch().to_pydict()
        steps = columns.get("step", [None] * len(next(iter(columns.values()))))
        for name, values in columns.items():
            for step, value in zip(steps, values, strict=True):
                if value is not None:
                    logged[chunk.entity_path][step][name] = value
    return logged


def scalars(logged: Logged, entity: str) -> list[float]:
    rows = logged[entity]
    return [rows[step]["Scalars:scalars"][0] for step in range(len(rows.keys() - {None}))]
