"""Checks that results belong to the checkpoint published with them, and to its environment."""

from pathlib import Path

from lerobot_bomb.bomb.environment import Environment
from lerobot_bomb.results.record import Record


def check_weights_of(path: Path, records: list[Record], checkpoint: Path) -> None:
    """Raise a ValueError if records of a results file belong to other weights than a checkpoint's folder.

    Records that name no policy, such as those of protocol 1.0, are accepted.
    """
    from lerobot_bomb.checkpoints.checks import ADAPTERS  # imports LeRobot: seconds
    from lerobot_bomb.checkpoints.identity import sha256_of, weights_file

    by_weights = {each.policy.weights_sha256: each for each in records if each.policy is not None}
    has_adapters = (checkpoint / ADAPTERS[1]).is_file()
    weights = weights_file(checkpoint, None, has_adapters)
    ours = None if weights is None else sha256_of(weights)
    for sha256, record in by_weights.items():
        if sha256 != ours:
            raise ValueError(
                f"--results={path} is of {record.describe_policy()}, not of {checkpoint}, whose weights have "
                f"the SHA-256 {ours}: evaluate this checkpoint, or name the file of its evaluation"
            )


def check_environment_of(path: Path, records: list[Record], trained_for: Environment | None) -> None:
    """Raise a ValueError if episodes were run in another environment than a checkpoint was trained for."""
    if trained_for is None:
        return
    for record in records:
        start = f"--results={path} has an episode "
        end = ": a card states no rate of another setting"
        environment = record.environment()
        if environment is None:
            raise ValueError(
                f"{start}of --env.type={record.env_type} (seed {record.spec.seed}); this checkpoint "
                f"was trained for {trained_for}{end}"
            )
        names = trained_for.differences(environment)
        if names:
            raise ValueError(
                f"{start}with {environment.text(names)} (seed {record.spec.seed}); this checkpoint was "
                f"trained for {trained_for.text(names)}{end}"
            )
