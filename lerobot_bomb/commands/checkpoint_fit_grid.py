"""``lerobot-bomb checkpoint fit-grid``: the action grid that a policy would fit on a dataset."""

import argparse
import json
from collections.abc import Callable
from typing import Any

from lerobot_bomb.actions.grid_settings import LAYOUT_FLAG, LAYOUTS, GridSettings
from lerobot_bomb.commands.arguments import add_dataset_arguments, path_flag
from lerobot_bomb.files import check_writable


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the dataset, and the settings of the grid as the policy has them."""
    add, default = parser.add_argument, GridSettings(())
    add_dataset_arguments(parser)
    groups = """as JSON: '[{"dims": [0, 1], "transform": "identity", "bins": [64, 64]}, ...]'"""
    add("--policy.action_groups", dest="groups", type=json_of(list), help=groups)
    layout = f"what the action is: {' or '.join(LAYOUTS)} (default: what the dimensions' names say)"
    add(LAYOUT_FLAG, dest="layout", help=layout)
    distribution = "of the edges: gaussian, uniform or quantile (default: gaussian)"
    add("--policy.grid_distribution", dest="distribution", default=default.distribution, help=distribution)
    sigma = "least standard deviation of a coordinate, in its unit (default: 0)"
    add("--policy.grid_min_sigma", dest="min_sigma", type=float, default=default.min_sigma, help=sigma)
    rho_dead = "length below which there is no motion (default: a fiftieth of the data's long motions)"
    add("--policy.rho_dead", dest="rho_dead", type=float, default=default.rho_dead, help=rho_dead)
    phi_fit = "where the angle phi is cut: wrapped or linear (default: wrapped)"
    add("--policy.phi_fit", dest="phi_fit", default=default.phi_fit, help=phi_fit)
    mapping = """as JSON, of which ACTION is read: '{"ACTION": "QUANTILES"}' (default: MIN_MAX)"""
    add("--policy.normalization_mapping", dest="mapping", type=json_of(dict), default={}, help=mapping)
    add("--plot", type=path_flag, help="also draw histograms with the edges into this file, as PNG")


def json_of(kind: type) -> Callable[[str], Any]:
    """Return argparse's reader of a flag that is JSON of this type."""

    def read(text: str) -> Any:
        value = json.loads(text)
        if not isinstance(value, kind):
            raise ValueError
        return value

    read.__name__ = f"JSON {kind.__name__}"  # what argparse calls it
    return read


def run(args: argparse.Namespace) -> int:
    """Fit, print the tables, draw the plot."""
    if args.plot is not None:
        check_writable("--plot", args.plot)
    from lerobot_bomb.viewing.fitted_grid import show_fit  # LeRobot and torch: seconds

    options = {name: getattr(args, name) for name in ("distribution", "min_sigma", "rho_dead", "phi_fit")}
    show_fit(args.repo_id, args.root, args.groups, args.layout, args.mapping, options, args.plot)
    return 0
