"""Identity of the policy that this process built, which LeRobot does not tell an environment."""

import hashlib
import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import draccus
from lerobot.configs import PreTrainedConfig
from lerobot.policies import PreTrainedPolicy

from lerobot_bomb.checkpoints.acting import acting_policy
from lerobot_bomb.checkpoints.checks import ADAPTERS, PROCESSORS
from lerobot_bomb.checkpoints.names import BLANK_IMAGES, REPLACE_TASKS, WEIGHTS, local_file
from lerobot_bomb.checkpoints.queries import time_queries
from lerobot_bomb.compat.hooks.evaluation import evaluated_step
from lerobot_bomb.compat.hooks.policies import training_data
from lerobot_bomb.files import read_json
from lerobot_bomb.results.origin import PolicyIdentity

PROCESSOR_PATTERNS = ("policy_preprocessor*", "policy_postprocessor*")
# fields of a config that do not change what the policy does
NOT_ITS_SETTINGS = {
    "device", "pretrained_path", "pretrained_revision", "package_version", "use_peft", "ignore_environment",
    "push_to_hub", "repo_id", "private", "tags", "license", "keep_statistics",
}  # fmt: skip


def identity_of(policy: PreTrainedPolicy) -> PolicyIdentity:
    """Return the identity of a policy; while it is being trained, only its type and the step."""
    if training_data(policy.config) is not None:
        return PolicyIdentity(policy.config.type, is_in_training=True, training_step=evaluated_step())
    return identity_of_config(policy.config)


def identity_of_config(config: PreTrainedConfig) -> PolicyIdentity:
    """Return the identity of the policy that is built from this config."""
    return PolicyIdentity(config.type) if config.pretrained_path is None else _of_checkpoint(config)


def policy_of_results(results_path: str | None, num_envs: int) -> list[dict[str, PolicyIdentity]]:
    """Return for each environment the argument that names the policy in its records; {} if there is none.

    LeRobot builds the policy after the environments. From now on its queries are timed.
    """
    policy = None if results_path is None else acting_policy()
    if policy is None:
        return [{}] * num_envs
    time_queries(policy)
    identity = identity_of(policy)
    return [{"policy": replace(identity, batch_size=num_envs, batch_row=row)} for row in range(num_envs)]


def weights_file(checkpoint: Path | str, revision: str | None, has_adapters: bool) -> Path | None:
    """Return the weights of a folder or a downloaded Hub repository; None if there is no such file."""
    return local_file(checkpoint, revision, ADAPTERS[1] if has_adapters else WEIGHTS)


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file's bytes, 64 hexadecimal digits; unchanged files are read only once."""
    status = path.stat()
    return _sha256(path.resolve(), status.st_mtime_ns, status.st_size)


@cache
def _sha256(path: Path, *_: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _of_checkpoint(config: PreTrainedConfig) -> PolicyIdentity:
    path, revision = str(config.pretrained_path), config.pretrained_revision
    weights = weights_file(path, revision, config.use_peft)
    is_folder = Path(path).is_dir()
    of_config, of_settings = (None, None) if weights is None else _settings_sha256(config, weights.parent)
    return PolicyIdentity(
        type=config.type,
        path=path,
        revision=revision if is_folder or weights is None else weights.parent.name,
        weights_sha256=None if weights is None else sha256_of(weights),
        settings_sha256=of_settings,
        base=_base(path, revision) if config.use_peft else None,
        interventions=() if weights is None else _interventions(weights.parent),
        config_sha256=of_config,
    )


def _interventions(folder: Path) -> tuple[str, ...]:
    path = folder / PROCESSORS[0]
    steps = read_json(path).get("steps", []) if path.is_file() else []
    names = [step.get("registry_name") for step in steps]
    return tuple(name for name in names if name in (BLANK_IMAGES, REPLACE_TASKS))


def _settings_sha256(config: PreTrainedConfig, folder: Path) -> tuple[str, str]:
    """Return the SHA-256 of the config with this evaluation's flags, and of it with the processors.

    The second is of all that changes what weights do.
    """
    settings: Any = draccus.encode(config)
    settings = {name: value for name, value in settings.items() if name not in NOT_ITS_SETTINGS}
    for name, as_before in getattr(config, "LATER_FIELDS", {}).items():
        for values in (settings, settings.get("trained_with") or {}):
            if name in values and values[name] == as_before:
                del values[name]
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True, default=str).encode())
    of_config = digest.hexdigest()
    found = (path for pattern in PROCESSOR_PATTERNS for path in folder.glob(pattern))
    for path in sorted(path for path in found if path.is_file()):
        digest.update(f"{path.name} {sha256_of(path)}".encode())
    return of_config, digest.hexdigest()


def _base(path: str, revision: str | None) -> str | None:
    """Name of the adapters' base, with its revision if that is fixed."""
    file = local_file(path, revision, ADAPTERS[0])
    adapters = {} if file is None else read_json(file)
    base, of_base = adapters.get("base_model_name_or_path"), adapters.get("revision")
    return f"{base}@{of_base}" if base and of_base else base
