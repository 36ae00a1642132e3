"""Whether results are of the checkpoint that is published with them."""

from pathlib import Path

from lerobot_bomb.envs.results import Row
from lerobot_bomb.evaluation.result_groups import describe_policy


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
