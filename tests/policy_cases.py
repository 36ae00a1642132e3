"""Every policy type's own cases: tiny policies (`make_policy`) and batches for them (`make_batch`)."""

from typing import Any

import fdvla_cases
import spatialvla_grid_cases
import vla0_smol_cases

CASES: dict[str, Any] = {
    "fdvla": fdvla_cases,
    "spatialvla_grid": spatialvla_grid_cases,
    "vla0_smol": vla0_smol_cases,
}
