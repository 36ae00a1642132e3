"""Files of configs/ are read by LeRobot's own parser, say what they claim, and train."""

from collections.abc import Callable, Iterator
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


def wrong_in(read: Any, written: dict[str, Any], *, but: frozenset[str] = frozenset()) -> Iterator[str]:
    """Fields that LeRobot's parser reads otherwise than they are written."""
    for name, value in written.items():
        found = getattr(read, name)
        found = str(found) if isinstance(found, Path) else found
        # LeRobot makes a tuple of a list
        if name not in but and (list(found) if isinstance(found, tuple) else found) != value:
            yield f"{name}: {value!r} is read as {found!r}"


def wrong_in_training(path: Path) -> Iterator[str]:
    written = yaml.safe_load(path.read_text())
    config = draccus.decode(TrainPipelineConfig, written)
    policy = written["policy"]
    assert isinstance(config.policy, PreTrainedConfig)
    if config.policy.type != policy.pop("type"):
        yield f"its policy is read as {config.policy.type}"
    yield from wrong_in(config, {name: written[name] for name in ("steps", "batch_size")})
    # LeRobot takes another device where the machine has none such
    yield from wrong_in(config.policy, policy, but=frozenset({"device"}))
    # the first line is the command, with the file's own name
    first_line = path.read_text().splitlines()[0]
    if not (
        "lerobot-train" in first_line and f"--config_path=configs/{path.relative_to(FOLDER)}" in first_line
    ):
        yield f"its first line is {first_line!r}"


def wrong_in_evaluation(path: Path) -> Iterator[str]:
    config, written = evaluation(path), yaml.safe_load(path.read_text())
    if config.env.type != written["env"].pop("type"):
        yield f"its environment is read as {config.env.type}"
    yield from wrong_in(config, {"seed": written["seed"]})
    yield from wrong_in(config.env, written["env"])
    yield from wrong_in(config.eval, written["eval"])
    first_line = path.read_text().splitlines()[0]
    if first_line != f"# lerobot-eval --config_path=configs/{path.name} --policy.path=CHECKPOINT":
        yield f"its first line is {first_line!r}"


@pytest.mark.parametrize(
    ("paths", "wrong"), [(TRAINING, wrong_in_training), (EVALUATION, wrong_in_evaluation)]
)
def test_lerobots_parser_reads_them(paths: list[Path], wrong: Callable[[Path], Iterator[str]]) -> None:
    register_third_party_plugins()
    assert paths and [f"{path.name}: {each}" for path in paths for each in wrong(path)] == []


def test_every_policy_has_a_preset_for_every_environment() -> None:
    assert {path.name for path in FOLDER.glob("train_*.yaml")} == {
        f"train_{policy}_{env}.yaml" for policy in POLICY_TYPES for env in ENVS
    } | {f"train_{policy}_bomb.yaml" for policy in STOCK_TYPES}
    assert {f"eval_{env}.yaml" for env in ENVS} <= {path.name for path in EVALUATION}


def test_what_an_environment_shows_a_policy() -> None:
    found = {env: policy_side(evaluation(FOLDER / f"eval_{env}.yaml").env) for env in ENVS}
    shapes = {env: {key: feature.shape for key, feature in shown.items()} for env, shown in found.items()}
    assert shapes == SEEN


@pytest.mark.parametrize("policy", POLICY_TYPES)
def test_presets_fit_their_environments(policy: str) -> None:
    configs = {env: preset(policy, env) for env in ENVS}
    for config in configs.values():
        config.validate_features()
    relative = {
        f"{policy}_{env}": config.relative_dims() if getattr(config, "relative_actions", False) else {}
        for env, config in configs.items()
    }
    assert relative == {name: SUBTRACTED.get(name, {}) for name in relative}
    if policy == "spatialvla_grid":
        groups = {env: len(config.grid_settings().groups) for env, config in configs.items()}
        assert groups == NUM_GROUPS


def test_actions_of_libero_are_a_pose_because_the_preset_says_so() -> None:
    config = preset("spatialvla_grid", "libero")
    config.action_layout = None
    with pytest.raises(ValueError, match=r"--policy\.action_layout=pose"):
        config.grid_settings()


def test_alohas_tasks_differ_in_task_and_demonstrations_alone() -> None:
    for command in ("eval", *(f"train_{policy}" for policy in POLICY_TYPES)):
        transfer, insertion = (
            yaml.safe_load((FOLDER / f"{command}_{env}.yaml").read_text())
            for env in ("aloha", "aloha_insertion")
        )
        if command == "eval":
            changed = {"env": {**transfer["env"], "task": "AlohaInsertion-v0"}}
        else:
            changed = {"dataset": {"repo_id": "lerobot/aloha_sim_insertion_human"}}
        assert insertion == {**transfer, **changed}, command


@pytest.mark.parametrize(
    ("prefix", "recipe_file", "ablations", "all_changes"),
    [
        ("vla0_smol_pusht_", RECIPE, ABLATIONS, CHANGES),
        ("spatialvla_grid_", GRID_RECIPE, GRID_ABLATIONS, GRID_CHANGES),
        ("fdvla_", FDVLA_RECIPE, FDVLA_ABLATIONS, FDVLA_CHANGES),
    ],
)
def test_ablations_change_what_their_rows_say(
    prefix: str, recipe_file: Path, ablations: list[Path], all_changes: dict[str, dict[str, Any]]
) -> None:
    recipe = yaml.safe_load(recipe_file.read_text())
    found = {path.stem.removeprefix(prefix): yaml.safe_load(path.read_text()) for path in ablations}
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
