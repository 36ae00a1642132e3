"""Cases of every policy type: tiny policies (`make_policy`) and batches for them (`make_batch`)."""

from pathlib import Path
from typing import Any

import fdvla_cases
import spatialvla_grid_cases
import vla0_smol_cases
from lerobot.policies import PreTrainedPolicy, make_pre_post_processors

CASES: dict[str, Any] = {
    "fdvla": fdvla_cases,
    "spatialvla_grid": spatialvla_grid_cases,
    "vla0_smol": vla0_smol_cases,
}


def save_checkpoint(policy_type: str, folder: Path, **options: Any) -> PreTrainedPolicy:
    """Config, weights and processors of a tiny policy, which is returned."""
    cases = CASES[policy_type]
    policy = cases.make_policy(**options)
    policy.save_pretrained(folder)
    stats = cases.STATS if policy_type == "vla0_smol" else cases.stats()
    for processor in make_pre_post_processors(policy.config, dataset_stats=stats):
        processor.save_pretrained(folder)
    return policy
