"""Replay of recorded episodes whose actions are clipped and rounded as a policy's grids do it.

The expert's eight episodes of benchmarks/overfit.py are replayed without looking, action by action, as
what encoding and decoding makes of them: the best that a policy can do that learned them by heart.

    python benchmarks/replay_rounded.py --json replay_rounded.json
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
import torch
from lerobot.configs import NormalizationMode
from machine import write_figures
from overfit import REPO_ID, SEED, TASK_IDS, record

from lerobot_bomb.actions.grid_fit import normalised, normalised_rest
from lerobot_bomb.actions.grid_settings import ActionGroup, GridSettings, default_groups
from lerobot_bomb.actions.grids import ActionGrids
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.observation import RenderOptions
from lerobot_bomb.bomb.suite import specs_of_tasks
from lerobot_bomb.commands.fit_grid import action_bounds
from lerobot_bomb.data.columns import read_columns, read_meta
from lerobot_bomb.envs.rollout import make_env
from lerobot_bomb.results.bomb import EpisodeResult
from lerobot_bomb.tables import print_table

PAIRS = (ActionGroup((0, 1), "identity", (64, 64)), ActionGroup((2, 3), "identity", (64, 16)))
GRIDS = {
    "clipped only": None,
    "default cells": GridSettings(default_groups(4)),
    "64 x 64 and 64 x 16 cells, gaussian": GridSettings(PAIRS),
    "64 x 64 and 64 x 16 cells, uniform": GridSettings(PAIRS, "uniform"),
}


def main() -> None:
    """Record, replay under every setting, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "dataset"
        record(root, ["image_size=32"])
        meta = read_meta(REPO_ID, root)
        columns = read_columns(meta, ("action",))
    actions_ND, episode_N = columns["action"].astype(np.float64), columns["episode_index"].ravel()
    rows = []
    for mode in (NormalizationMode.QUANTILES, NormalizationMode.MIN_MAX):
        low_D, high_D = action_bounds(meta, mode)
        for name, settings in GRIDS.items():
            rounded_ND = rounded(actions_ND, low_D, high_D, settings)
            results = [replay(task, rounded_ND[episode_N == i]) for i, task in enumerate(TASK_IDS)]
            errors_mm = [result.placement_error_mm for result in results]
            rows.append(
                {
                    "normalised by": mode.value,
                    "grids": name,
                    "successes": sum(result.is_success for result in results),
                    "largest error, mm": max(errors_mm),
                    "mean action error": float(np.abs(rounded_ND - actions_ND).mean()),
                }
            )
    print_table(
        [*rows[0]], [[f"{x:.3g}" if isinstance(x, float) else str(x) for x in row.values()] for row in rows]
    )
    write_figures(args.json, {"episodes": len(TASK_IDS), "rows": rows})


def rounded(
    actions_ND: np.ndarray, low_D: np.ndarray, high_D: np.ndarray, settings: GridSettings | None
) -> np.ndarray:
    """(N, D) what is left of actions that are clipped to [low, high], and put into cells fitted to them."""
    values_ND = normalised(actions_ND, low_D, high_D).clip(-1, 1)
    if settings is not None:
        grids = ActionGrids(settings, len(low_D))
        grids.fit(values_ND, normalised_rest(low_D, high_D))
        values_ND = grids.decode(grids.encode(torch.from_numpy(values_ND))).numpy()
    return (values_ND + 1) / 2 * (high_D - low_D) + low_D


def replay(task_id: int, actions_TD: np.ndarray) -> EpisodeResult:
    """The episode of the task under these actions, the last one held until it ends."""
    env = make_env(specs_of_tasks(EpisodeSpec(SEED), [task_id])[0], RenderOptions(image_size=32))
    env.reset(seed=SEED)
    step, has_ended = 0, False
    while not has_ended:
        action = actions_TD[min(step, len(actions_TD) - 1)].astype(np.float32).clip(-1, 1)
        _, _, terminated, truncated, _ = env.step(action)
        step, has_ended = step + 1, terminated or truncated
    result = env.get_wrapper_attr("episode_result")()
    env.close()
    return result


if __name__ == "__main__":
    main()
