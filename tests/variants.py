"""Small policies that proofs are about, and options that every proof is repeated with."""

import json
from typing import Any

import pytest
from recipes import read_recipe

type Options = dict[str, Any]

ENSEMBLE: Options = {
    "temporal_ensemble_size": 3,
    "temporal_ensemble_weighting": "uniform",  # what is proven is a mean
    "n_action_steps": 1,
}
NO_MASKING: Options = {"mask_max_fraction": 0.0}
CENTERS: Options = {"bin_mode": "centers"}
FIXED_WIDTH: Options = {"number_width": 4}  # a digit more than the bins need
CAUSAL: Options = {"prefix_attention": "causal"}
QUANTILE: Options = {"grid_distribution": "quantile", "decode_point": "centroid"}
FLOW_ONLY: Options = {"use_denoise_head": False}
DENOISE_ONLY: Options = {"use_flow_head": False}
CAUSAL_SEGMENT: Options = {"segment_attention": "causal"}
POOL_ALL: Options = {"reasoning_pool": "all_prefix"}
FULL_LOSS: Options = {"loss_vocab": "full"}

TWO_LAYERS: Options = {"nano_config": {"text_config": {"num_hidden_layers": 2}}}
SHORT_CHUNKS: Options = {"chunk_size": 3, "n_action_steps": 3}
# by policy type
OPTIONS: dict[str, dict[str, Options]] = {
    "vla0_smol": {
        "ensemble": ENSEMBLE,
        "no_masking": NO_MASKING,
        "centers": CENTERS,
        "fixed_width": FIXED_WIDTH,
    },
    "spatialvla_grid": {
        "ensemble": ENSEMBLE,
        "causal": CAUSAL,
        "quantile": QUANTILE,
        "full_loss": FULL_LOSS,
    },
    "fdvla": {
        "flow_only": FLOW_ONLY,
        "denoise_only": DENOISE_ONLY,
        "causal_segment": CAUSAL_SEGMENT,
        "pool_all": POOL_ALL,
    },
}


def small_network(policy_type: str) -> Options:
    """Return the network of one_target_TYPE.yaml.

    It sees fewer patches through fewer layers: learning by heart takes a third of the time.
    """
    network = read_recipe("one_target", policy_type)["policy"]
    return {name: network[name] for name in ("nano_config", "image_size") if name in network}


def small_policy(policy_type: str) -> Options:
    """Return what configs/overfit_TYPE.yaml sets, for short chunks and a small network."""
    return read_recipe("overfit", policy_type)["policy"] | small_network(policy_type) | SHORT_CHUNKS


def layers_of(options: Options) -> Options:
    """Nano with two layers, one to write what the other reads, unless the options choose another model."""
    return {} if "vlm_model_name" in options else TWO_LAYERS


def variants_of(policy_type: str) -> list[Any]:
    """Parameters (policy_type, options): the recipe, then, if there is time, each of its options."""
    options = OPTIONS.get(policy_type, {})
    return [
        pytest.param(policy_type, {}, id=policy_type),
        *(
            pytest.param(policy_type, each, id=f"{policy_type}-{name}", marks=pytest.mark.long)
            for name, each in options.items()
        ),
    ]


def as_flags(options: Options) -> list[str]:
    """--policy.* flags of LeRobot's commands."""
    return [
        f"--policy.{name}={value if isinstance(value, str) else json.dumps(value)}"
        for name, value in options.items()
    ]
