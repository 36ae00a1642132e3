"""Files of configs/ are read by LeRobot's own parser, say what they claim, and train."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import draccus
import pytest
import yaml
from lerobot.configs import PipelineFeatureType, PolicyFeature, PreTrainedConfig
from lerobot.configs.eval import EvalPipelineConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.envs import EnvConfig, env_to_policy_features
from lerobot.policies.factory import get_policy_class
from lerobot.utils.constants import ACTION, OBS_STATE
from lerobot.utils.import_utils import register_third_party_plugins
from recipes import FOLDER, POLICY_TYPES

# what lerobot-train starts from: the evaluation's configs name an environment and no policy, and what goes on
# from a checkpoint is read in test_shipped.py
TRAINING = sorted(path for path in FOLDER.rglob("*.yaml") if "policy:\n  type:" in path.read_text())
EVALUATION = sorted(FOLDER.glob("eval_*.yaml"))
# LeRobot's own policies, on BOMB alone (test_stock_policies.py)
STOCK_TYPES = ("act", "diffusion", "pi0", "pi05", "pi0_fast", "smolvla", "xvla")
ENVS = ("aloha", "aloha_insertion", "bomb", "libero", "pusht")
# what a policy is shown there, and the actions that it takes; PushT's pictures have 96 pixels a side,
# whatever LeRobot declares (test_pusht_env.py)
ALOHA = {"observation.images.top": (3, 480, 640), "observation.state": (14,), "action": (14,)}
SEEN: dict[str, dict[str, tuple[int, ...]]] = {
    "aloha": ALOHA,
    "aloha_insertion": ALOHA,
    "bomb": {
        "observation.images.workspace": (3, 256, 256),
        "observation.images.wrist": (3, 256, 256),
        "observation.state": (4,),
        "action": (4,),
    },
    "libero": {
        "observation.images.image": (3, 256, 256),
        "observation.images.image2": (3, 256, 256),
        "observation.state": (8,),
        "action": (7,),
    },
    "pusht": {"observation.image": (3, 384, 384), "observation.state": (2,), "action": (2,)},
}
# tokens that spatialvla_grid writes for a step
NUM_GROUPS = {"aloha": 14, "aloha_insertion": 14, "bomb": 2, "libero": 3, "pusht": 2}
# presets with relative actions: {action dimension: the state dimension that is subtracted}; nobody else's are
SUBTRACTED: dict[str, dict[int, int]] = {"vla0_smol_pusht": {0: 0, 1: 1}}
RECIPE = FOLDER / "train_vla0_smol_pusht.yaml"
ABLATIONS = sorted((FOLDER / "ablations").glob("vla0_smol_*.yaml"))
GRID_RECIPE = FOLDER / "train_spatialvla_grid_bomb.yaml"
GRID_ABLATIONS = sorted((FOLDER / "ablations").glob("spatialvla_grid_*.yaml"))
FDVLA_RECIPE = FOLDER / "train_fdvla_bomb.yaml"
FDVLA_ABLATIONS = sorted((FOLDER / "ablations").glob("fdvla_*.yaml"))
FDVLA_CHANGES: dict[str, dict[str, Any]] = {
    "causal_segment": {"segment_attention": "causal"},
    "diffusion_only": {"use_flow_head": False},
    "flow_only": {"use_denoise_head": False},
    "no_denoise_mod": {"dualmod_denoise": False},
    "no_dualmod": {"dualmod_flow": False, "dualmod_denoise": False},
    "no_flow_mod": {"dualmod_flow": False},
}
EVEN = {"grid_distribution": "uniform", "decode_point": "mid"}
GRID_CHANGES: dict[str, dict[str, Any]] = {
    "linear_bins": {
        **EVEN,
        "action_groups": [{"dims": [dim], "transform": "identity", "bins": [256]} for dim in range(4)],
    },
    "no_ego3d": {"depth_source": "none"},
    "small_grid": {
        "action_groups": [
            {"dims": [0, 1, 2], "transform": "polar", "bins": [8, 16, 4]},
            {"dims": [3], "transform": "identity", "bins": [8]},
        ]
    },
    "trained_embeddings": {"freeze_llm_embeddings": False},
    "uniform_grid": EVEN,
}
# what each row of the published table changes in the recipe on PushT, which has relative actions, the state
# in the prompt and masking; rows without a number were published as relative actions with state, unmasked
NO_MASKING, NO_STATE = {"mask_max_fraction": 0.0}, {"use_state": False}
CHANGES: dict[str, dict[str, Any]] = {
    "absolute": {**NO_MASKING, **NO_STATE, "relative_actions": False},
    "absolute_state": {**NO_MASKING, "relative_actions": False},
    "ensemble": {
        **NO_MASKING,
        "n_action_steps": 1,
        "temporal_ensemble_size": 10,
        "temporal_ensemble_weighting": "uniform",
    },
    "frozen_vision": {**NO_MASKING, **NO_STATE, "freeze_vision_encoder": True},
    "lr_1e-4": {**NO_MASKING, **NO_STATE, "optimizer_lr": 1e-4},
    "lr_1e-5": {**NO_MASKING, **NO_STATE, "optimizer_lr": 1e-5},
    "lr_5e-6": {**NO_MASKING, **NO_STATE, "optimizer_lr": 5e-6},
    "masking": {},
    "relative": {**NO_MASKING, **NO_STATE},
    "relative_state": NO_MASKING,
    "system_prompt": {
        **NO_MASKING,
        "system_prompt": "Look at the picture and read the task. "
        "Write the next 10 actions as 20 numbers from 0 to 511.",
    },
}


def name_of(path: Path) -> str:
    return path.stem.removeprefix("vla0_smol_pusht_")


def evaluation(path: Path) -> EvalPipelineConfig:
    """Read a file as lerobot-eval does, but for the checkpoint."""
    register_third_party_plugins()
    return draccus.decode(EvalPipelineConfig, yaml.safe_load(path.read_text()))


def policy_side(env: EnvConfig) -> dict[str, PolicyFeature]:
    """Return what a policy reads and writes there, behind the environment's own processor."""
    preprocessor, _ = env.get_env_processors()
    by_kind = preprocessor.transform_features({PipelineFeatureType.OBSERVATION: env_to_policy_features(env)})
    features = {key: feature for of_kind in by_kind.values() for key, feature in of_kind.items()}
    # LIBERO's processor makes one state of its parts, and leaves their declarations
    return {key: feature for key, feature in features.items() if not key.startswith(f"{OBS_STATE}.")}


def preset(policy: str, env_name: str) -> Any:
    """The policy of ``train_<policy>_<env>.yaml``, for the environment that ``eval_<env>.yaml`` names."""
    env = evaluation(FOLDER / f"eval_{env_name}.yaml").env
    written = yaml.safe_load((FOLDER / f"train_{policy}_{env_name}.yaml").read_text())
    config = draccus.decode(TrainPipelineConfig, written).policy
    assert config is not None
    if getattr(config, "depth_source", None) == "observation":
        env = replace(env, depth=True)
    features = policy_side(env)
    config.output_features = {ACTION: features.pop(ACTION)}
    config.input_features = features
    return config


@pytest.mark.parametrize("path", TRAINING, ids=lambda path: path.stem)
def test_lerobots_parser_reads_it(path: Path) -> None:
    register_third_party_plugins()
    written = yaml.safe_load(path.read_text())
    config = draccus.decode(TrainPipelineConfig, written)
    assert config.steps == written["steps"] and config.batch_size == written["batch_size"]
    assert isinstance(config.policy, PreTrainedConfig) and config.policy.type == written["policy"].pop("type")
    for name, value in written["policy"].items():
        read = getattr(config.policy, name)
        read = str(read) if isinstance(read, Path) else read
        # LeRobot takes another device where the machine has none such, and makes a tuple of a list
        assert name == "device" or (list(read) if isinstance(read, tuple) else read) == value, name
    # the first line is the command, with the file's own name
    first_line = path.read_text().splitlines()[0]
    assert "lerobot-train" in first_line and f"--config_path=configs/{path.relative_to(FOLDER)}" in first_line


@pytest.mark.parametrize("path", EVALUATION, ids=lambda path: path.stem)
def test_lerobots_parser_reads_an_evaluation(path: Path) -> None:
    config, written = evaluation(path), yaml.safe_load(path.read_text())
    assert config.env.type == written["env"].pop("type") and config.seed == written["seed"]
    for name, value in written["env"].items():
        assert getattr(config.env, name) == value, name
    for name, value in written["eval"].items():
        assert getattr(config.eval, name) == value, name
    first_line = path.read_text().splitlines()[0]
    assert first_line == f"# lerobot-eval --config_path=configs/{path.name} --policy.path=CHECKPOINT"


def test_every_policy_has_a_preset_for_every_environment() -> None:
    assert {path.name for path in FOLDER.glob("train_*.yaml")} == {
        f"train_{policy}_{env}.yaml" for policy in POLICY_TYPES for env in ENVS
    } | {f"train_{policy}_bomb.yaml" for policy in STOCK_TYPES}
    assert {f"eval_{env}.yaml" for env in ENVS} <= {path.name for path in EVALUATION}


@pytest.mark.parametrize("env", ENVS)
def test_what_an_environment_shows_a_policy(env: str) -> None:
    features = policy_side(evaluation(FOLDER / f"eval_{env}.yaml").env)
    assert {key: feature.shape for key, feature in features.items()} == SEEN[env]


@pytest.mark.parametrize("env", ENVS)
@pytest.mark.parametrize("policy", POLICY_TYPES)
def test_a_preset_fits_its_environment(policy: str, env: str) -> None:
    config = preset(policy, env)
    config.validate_features()
    relative = config.relative_dims() if getattr(config, "relative_actions", False) else {}
    assert relative == SUBTRACTED.get(f"{policy}_{env}", {})
    if policy == "spatialvla_grid":
        assert len(config.grid_settings().groups) == NUM_GROUPS[env]


def test_actions_of_libero_are_a_pose_because_the_preset_says_so() -> None:
    config = preset("spatialvla_grid", "libero")
    config.action_layout = None
    with pytest.raises(ValueError, match=r"--policy\.action_layout=pose"):
        config.grid_settings()


@pytest.mark.parametrize("command", ["eval", *(f"train_{policy}" for policy in POLICY_TYPES)])
def test_alohas_two_tasks_differ_in_task_and_demonstrations_alone(command: str) -> None:
    transfer, insertion = (
        yaml.safe_load((FOLDER / f"{command}_{env}.yaml").read_text()) for env in ("aloha", "aloha_insertion")
    )
    if command == "eval":
        assert insertion == {**transfer, "env": {**transfer["env"], "task": "AlohaInsertion-v0"}}
    else:
        assert insertion == {**transfer, "dataset": {"repo_id": "lerobot/aloha_sim_insertion_human"}}


def test_the_table_names_every_ablation() -> None:
    assert [name_of(path) for path in ABLATIONS] == sorted(CHANGES)


@pytest.mark.parametrize("path", ABLATIONS, ids=name_of)
def test_an_ablation_changes_what_its_row_says(path: Path) -> None:
    recipe, ablation = yaml.safe_load(RECIPE.read_text()), yaml.safe_load(path.read_text())
    assert ablation == {**recipe, "policy": {**recipe["policy"], **CHANGES[name_of(path)]}}


@pytest.mark.parametrize(
    ("policy_name", "recipe_file", "ablations", "all_changes"),
    [
        ("spatialvla_grid", GRID_RECIPE, GRID_ABLATIONS, GRID_CHANGES),
        ("fdvla", FDVLA_RECIPE, FDVLA_ABLATIONS, FDVLA_CHANGES),
    ],
)
def test_ablations_on_bomb_change_what_their_rows_say(
    policy_name: str, recipe_file: Path, ablations: list[Path], all_changes: dict[str, dict[str, Any]]
) -> None:
    recipe = yaml.safe_load(recipe_file.read_text())
    found = {
        path.stem.removeprefix(f"{policy_name}_"): yaml.safe_load(path.read_text()) for path in ablations
    }
    assert found == {
        name: {**recipe, "policy": {**recipe["policy"], **changes}} for name, changes in all_changes.items()
    }


ONE_IS_ENOUGH = "ensemble"  # it differs most from what other fast tests train
RUNS = [
    pytest.param(path, marks=() if name_of(path) == ONE_IS_ENOUGH else pytest.mark.long, id=path.stem)
    for path in (RECIPE, *ABLATIONS)
]


@pytest.mark.parametrize("path", RUNS)
def test_the_stock_command_trains_it(
    path: Path, stock_cli: Callable[..., None], pusht_dataset: Path, tmp_path: Path
) -> None:
    """One step on the real demonstrations, on a small network and a CPU."""
    own = "--policy.vlm_model_name=nano --policy.device=cpu --policy.dtype=float32 --wandb.enable=false"
    own += " --batch_size=2 --num_workers=0 --steps=1 --save_freq=1"
    data = [f"--dataset.root={pusht_dataset}", f"--output_dir={tmp_path / 'train'}"]
    stock_cli("lerobot-train", f"--config_path={path}", *data, *own.split())
    checkpoint = tmp_path / "train" / "checkpoints" / "last" / "pretrained_model"
    policy = get_policy_class("vla0_smol").from_pretrained(checkpoint)
    for name, value in yaml.safe_load(path.read_text())["policy"].items():
        assert name in ("device", "dtype") or getattr(policy.config, name) == value, name
