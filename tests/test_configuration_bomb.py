from pathlib import Path

import numpy as np
import pytest
import yaml
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs import env_to_policy_features, make_env, make_env_config
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_bomb.bomb.perturbations import NUISANCES
from lerobot_bomb.bomb.suites import SUITES
from lerobot_bomb.envs.vector import LazyVectorEnv
from lerobot_bomb.flag_errors import FlagError
from lerobot_env_bomb.bomb.configuration_bomb import BombEnvConfig


def test_policy_side_features() -> None:
    features = env_to_policy_features(make_env_config("bomb", image_size=64))
    shapes = {key: (feature.type.value, feature.shape) for key, feature in features.items()}
    assert shapes == {
        "action": ("ACTION", (4,)),
        "observation.state": ("STATE", (4,)),
        "observation.images.workspace": ("VISUAL", (3, 64, 64)),
        "observation.images.wrist": ("VISUAL", (3, 64, 64)),
    }


def test_images_are_as_large_as_the_policy_was_trained_on_unless_a_flag_says_otherwise() -> None:
    image = PolicyFeature(FeatureType.VISUAL, (3, 96, 96))
    trained = ACTConfig(input_features={"observation.images.wrist": image, "observation.images.top": image})
    cases = ((None, trained, 96), (64, trained, 64), (None, ACTConfig(), 256), (None, None, 256))
    for given, config, side in cases:
        env = BombEnvConfig(image_size=given)
        env.take_image_size(config)
        assert env.features["observation.images.workspace"].shape == (side, side, 3)
        assert env.render_options.image_size == env.environment.image_size == side


def test_a_suite_maps_task_numbers_to_vector_envs() -> None:
    envs = make_env(make_env_config("bomb", task_ids=[0, 38]), n_envs=3, use_async_envs=True)
    assert list(envs) == ["place"]
    assert list(envs["place"]) == [0, 38]
    assert all(
        isinstance(vector, LazyVectorEnv) and vector.num_envs == 3 for vector in envs["place"].values()
    )


def test_task_ids_fix_target_and_colour() -> None:
    vector = make_env(make_env_config("bomb", task_ids=[38], image_size=32), n_envs=1)["place"][38]
    assert isinstance(vector, LazyVectorEnv)
    vector.reset(seed=[3])
    instruction = vector.call("task_description")[0]
    assert "white" in instruction
    assert "2" in instruction and "3" in instruction
    vector.close()


def test_each_condition_is_a_group_with_all_tasks() -> None:
    conditions = ["none", "light:3+camera:2", "all:1-5"]
    config = make_env_config("bomb", task_ids=[0, 38], perturbations=conditions, image_size=32)
    envs = make_env(config, n_envs=1)
    assert list(envs) == ["place.none", "place.camera-2.light-3", "place.all-1to5"]
    assert all(list(group) == [0, 38] for group in envs.values())
    instructions, images = [], []
    for key in ("place.none", "place.camera-2.light-3"):
        vector = envs[key][38]
        assert isinstance(vector, LazyVectorEnv)
        images.append(vector.reset(seed=[3])[0]["pixels"]["workspace"])
        instructions.append(vector.call("task_description"))
        vector.close()
    assert instructions[0] == instructions[1]
    assert not np.array_equal(*images)


def test_all_is_a_group_for_every_suite_and_condition() -> None:
    config = BombEnvConfig(task="all", perturbations=["none", "camera:3"], image_size=32)
    envs = make_env(config, n_envs=1)
    assert list(envs) == [f"{suite}.{key}" for suite in SUITES for key in ("none", "camera-3")]
    for key, specs in config.groups.items():
        (spec,) = specs.values()
        suite, _, condition = key.partition(".")
        assert (spec.suite, spec.perturbations) == (suite, condition.replace("-", ":"))


def test_the_protocol_s_file_names_every_axis() -> None:
    path = Path(__file__).parents[1] / "configs" / "eval_bomb_place.yaml"
    flags = yaml.safe_load(path.read_text())["env"]
    assert flags.pop("type") == "bomb"
    conditions = {specs[0].perturbations for specs in BombEnvConfig(**flags).groups.values()}
    assert conditions == {"none", "all:1", "all:3", "all:5", *(f"{axis}:3" for axis in NUISANCES)}


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ({"perturbations": ["haze:1"]}, r"--env.perturbations='haze:1': 'haze' is not an axis"),
        ({"perturbations": ["camera:6"]}, r"--env.perturbations='camera:6': the levels of camera must lie"),
        ({"perturbations": ["camera"]}, r"--env.perturbations='camera': 'camera' is not a perturbation"),
        ({"perturbations": "camera:3"}, r"=camera:3 must be a list, with brackets and quotes: --env.perturb"),
        ({"perturbations": []}, r"--env.perturbations=\[\] names no condition"),
        ({"perturbations": ["none", "all:0"]}, "a condition twice"),
        ({"task": "plce"}, "--env.task='plce'"),
        ({"robot": "panda"}, "--env.robot='panda'"),
        ({"control_mode": "joint"}, "--env.control_mode='joint'"),
        ({"fps": 7}, "--env.fps=7"),
        ({"target": [5, 5]}, r"--env.target=\[5, 5\]"),
        ({"target": [1]}, r"--env.target=\[1\]"),
        ({"color": "blue"}, "--env.color='blue'"),
        ({"image_size": -1}, "--env.image_size=-1"),
        ({"render_preset": "rt"}, "--env.render_preset='rt'"),
        ({"task_ids": [50]}, "--env.task_ids has 50"),
        ({"task_ids": [3, 1, 3]}, r"--env.task_ids=\[3, 1, 3\] has a task twice"),
        ({"task_ids": []}, r"--env.task_ids=\[\]"),
        ({"task_ids": [1], "color": "black"}, "drop --env.target and --env.color"),
    ],
)
def test_wrong_flags_fail_before_an_environment_is_built(flags: dict, message: str) -> None:
    with pytest.raises(FlagError, match=message):
        BombEnvConfig(**flags)


def test_an_unwritable_results_folder_is_refused(tmp_path: Path) -> None:
    blocker = tmp_path / "file"
    blocker.write_text("")
    config = BombEnvConfig(results_path=str(blocker / "results.jsonl"))
    with pytest.raises(ValueError, match=r"--env\.results_path="):
        config.create_envs(n_envs=1)


@pytest.mark.parametrize("env_type", ["bomb", "bomb_pusht", "bomb_libero"])
def test_tasks_in_threads_are_refused_at_once(env_type: str) -> None:
    register_third_party_plugins()
    with pytest.raises(FlagError, match=r"--env\.max_parallel_tasks=3 runs tasks in threads") as error:
        make_env_config(env_type, max_parallel_tasks=3)
    assert "drop it" in str(error.value) and "lerobot-bomb sweep --workers=3" in str(error.value)
    assert make_env_config(env_type, max_parallel_tasks=1).max_parallel_tasks == 1
