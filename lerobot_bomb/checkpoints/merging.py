"""Adapters and their base as one checkpoint."""

from pathlib import Path

from lerobot.configs import PreTrainedConfig
from lerobot.policies import PreTrainedPolicy, get_policy_class

from lerobot_bomb.checkpoints.adapters import check_adapters_fit
from lerobot_bomb.checkpoints.checks import ADAPTERS
from lerobot_bomb.checkpoints.folder import load_processors, read_config, write_checkpoint


def merge(adapters: Path, output: Path) -> None:
    """Merge adapters into their base, and write the checkpoint to a new folder.

    Raises:
        ValueError: there are no adapters in the folder, or their base cannot be loaded.
    """
    config = read_config(adapters, "cpu")
    if not config.use_peft:
        raise ValueError(f"--policy.path={adapters} is a whole checkpoint: there is nothing to merge")
    pipelines = load_processors(config)
    write_checkpoint(output, merged(config, adapters), pipelines)


def merged(config: PreTrainedConfig, adapters: Path) -> PreTrainedPolicy:
    """Merge base and adapters into one policy, with the config of a policy without adapters."""
    check_adapters_fit(get_policy_class(config.type), config, str(adapters), None)
    import peft  # pyright: ignore[reportMissingImports]

    of_adapters = peft.PeftConfig.from_pretrained(str(adapters))
    base = str(of_adapters.base_model_name_or_path)
    config.use_peft, config.pretrained_path = False, None
    try:
        policy = get_policy_class(config.type).from_pretrained(
            base, config=config, revision=of_adapters.revision
        )
    except (OSError, ValueError) as error:
        raise ValueError(
            f"--policy.path={adapters} holds adapters of {base}, as {ADAPTERS[0]} says, which cannot be "
            f"loaded: {str(error).splitlines()[0]}"
        ) from error
    return peft.PeftModel.from_pretrained(policy, str(adapters)).merge_and_unload()
