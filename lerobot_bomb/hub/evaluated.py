"""Checks that results belong to the checkpoint published with them, and to its environment."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_bomb.bomb.environment import Environment
from lerobot_bomb.results.record import Record

if TYPE_CHECKING:
    from lerobot_bomb.results.origin import PolicyIdentity


def check_policy_of(path: Path, records: list[Record], checkpoint: Path) -> None:
    """Raise a ValueError if records of a results file belong to another policy than a checkpoint's folder.

    Records that name no policy or no settings, such as those of protocol 1.0, are accepted.
    """
    identities = _identities(checkpoint)
    ours = identities[0].weights_sha256
    settings = {None, *(each.settings_sha256 for each in identities)}
    for record in {each.policy: each for each in records if each.policy is not None}.values():
        policy = record.policy
        assert policy is not None
        start = f"--results={path} is of {record.describe_policy()}, not of {checkpoint}"
        if policy.weights_sha256 != ours:
            raise ValueError(
                f"{start}, whose weights have the SHA-256 {ours}: evaluate this checkpoint, or name the file "
                "of its evaluation"
            )
        if policy.interventions != identities[0].interventions or policy.settings_sha256 not in settings:
            raise ValueError(
                f"{start} as it is: other --policy.* flags or processors were used; a card states no rate of "
                "those"
            )


def _identities(checkpoint: Path) -> list["PolicyIdentity"]:
    """Return the policy of a folder, as records name it that were written before and after it was built."""
    from lerobot_bomb.checkpoints.checks import policy_class  # imports LeRobot: seconds
    from lerobot_bomb.checkpoints.folder import read_config
    from lerobot_bomb.checkpoints.identity import identity_of_config
    from lerobot_bomb.training.policy_flags import trained_with

    config: Any = read_config(checkpoint, None)
    as_read = identity_of_config(config)
    found: Any = policy_class(checkpoint)
    config.trained_with = trained_with(config, found.as_trained)
    return [as_read, identity_of_config(config)]


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
