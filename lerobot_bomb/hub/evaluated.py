"""Checks that results are of the checkpoint that is published with them, and of its environment."""

from pathlib import Path

from lerobot_bomb.data.environment import Environment
from lerobot_bomb.envs.results import Row
from lerobot_bomb.evaluation.result_groups import describe_policy
from lerobot_bomb.evaluation.result_lines import kind_of


def check_weights_of(path: Path, rows: list[Row], checkpoint: Path) -> None:
    """Raise a ValueError if the rows of a results file are of other weights than a checkpoint's folder.

    Rows that name no policy, as those of protocol 1.0, may be of any.
    """
    from lerobot_bomb.checkpoints.checks import ADAPTERS  # imports LeRobot: seconds
    from lerobot_bomb.checkpoints.identity import sha256_of, weights_file

    of_rows = {row["policy"]["weights_sha256"]: row for row in rows if row.get("policy") is not None}
    has_adapters = (checkpoint / ADAPTERS[1]).is_file()
    weights = weights_file(checkpoint, None, has_adapters)
    ours = None if weights is None else sha256_of(weights)
    for sha256, row in of_rows.items():
        if sha256 != ours:
            raise ValueError(
                f"--results={path} is of {describe_policy(row)}, not of {checkpoint}, whose weights have the "
                f"SHA-256 {ours}: evaluate this checkpoint, or name the file of its evaluation"
            )


def check_environment_of(path: Path, rows: list[Row], trained_for: Environment | None) -> None:
    """Raise a ValueError if episodes were run in another environment than a checkpoint was trained for."""
    if trained_for is None:
        return
    for row in rows:
        start = f"--results={path} has an episode "
        end = ": a card states no rate of another setting"
        played_in = kind_of(row).environment(row)
        if played_in is None:
            raise ValueError(
                f"{start}of --env.type={kind_of(row).env_type} (seed {row['spec']['seed']}); this checkpoint "
                f"was trained for {trained_for}{end}"
            )
        names = trained_for.differences(played_in)
        if names:
            raise ValueError(
                f"{start}with {played_in.text(names)} (seed {row['spec']['seed']}); this checkpoint was "
                f"trained for {trained_for.text(names)}{end}"
            )
