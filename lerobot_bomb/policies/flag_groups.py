"""Groups of a policy's flags: those that ``--help`` lists, and those that it leaves to the docs.

A config names its own fields of a group in a ClassVar of the group's name.
"""

from dataclasses import fields

from lerobot_bomb.compat.help import leave_out_of_help

# fields of the bases by group
SHARED = {
    # no user sets them: they are filled in, or have one allowed value
    "FILLED_IN": (
        *("n_obs_steps", "input_features", "output_features", "use_amp", "use_peft"),
        *("pretrained_path", "pretrained_revision", "environment", "trained_with", "trained_batches"),
        *("package_version", "vlm_config", "prompt_tokens", "action_feature_names", "pointing_places"),
    ),
    # for experiments with a method
    "RESEARCH": (
        *("nano_config", "normalization_mapping", "loss_on_padded_actions", "drop_n_last_frames"),
        *("optimizer", "optimizer_betas", "optimizer_eps"),
        *("optimizer_weight_decay", "optimizer_grad_clip_norm"),
        *("temporal_ensemble_weighting", "temporal_ensemble_coefficient", "temperature", "noise_seed"),
        *("counterfactual_share", "board_loss_weight", "pointing_loss_weight", "scheduler_decay_lr"),
    ),
}


def flags_of(config_class: type, group: str) -> list[str]:
    """Return a config's fields of a group, in the order of the class."""
    names = {*SHARED[group], *vars(config_class).get(group, ())}
    return [each.name for each in fields(config_class) if each.name in names]


def short_help[T: type](config_class: T) -> T:
    """Leave fields for research, and those that the code fills in, out of a config's help; all flags work."""
    leave_out_of_help(config_class, [name for group in SHARED for name in flags_of(config_class, group)])
    return config_class
