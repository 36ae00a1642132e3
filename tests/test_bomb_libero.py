"""`bomb_libero` without a simulator: flags, words, records."""

import json
import re
import shlex
from pathlib import Path

import pytest

from lerobot_bomb.commands.main import main
from lerobot_bomb.conditions import MAX_LEVEL
from lerobot_bomb.flag_errors import FlagError
from lerobot_bomb.libero.assets import SUITES, Libero
from lerobot_bomb.libero.episode import LiberoFailure, LiberoSpec, initial_state_of, libero_failure_of
from lerobot_bomb.libero.perturbations import LIBERO_AXES
from lerobot_bomb.libero.wording import FORMS, orders_of, reworded
from lerobot_bomb.results.libero import LiberoResult
from lerobot_env_bomb.libero.configuration_bomb_libero import BombLiberoEnvConfig

VERBS = {
    "pick",
    "up",
    "put",
    "place",
    "push",
    "stack",
    "open",
    "close",
    "turn",
    "on",
    "off",
    "and",
    "it",
    "them",
}
INSTRUCTIONS = (
    "pick up the black bowl next to the plate and place it on the plate",
    "stack the black bowl at the front on the black bowl in the middle",
    "put the yellow and white mug in the microwave and close it",
    "open the top drawer and put the bowl inside",
    "put both the cream cheese box and the butter in the basket",
    "turn on the stove and put the moka pot on it",
    "stack the left bowl on the right bowl and place them in the tray",
)


def instructions_of(libero: Libero) -> set[str]:
    """Return the instructions of all 130 tasks, by their files' names, as LeRobot gives them."""
    names = [path.stem for path in libero.task_folders()["bddl_files"].glob("libero_*/*.bddl")]
    return {re.sub(r"^[A-Z_0-9]*SCENE\d+_", "", name).replace("_", " ") for name in names}


@pytest.mark.parametrize("instruction", INSTRUCTIONS)
def test_every_form_names_the_same_things_and_places(instruction: str) -> None:
    said = {reworded(instruction, form, variant) for form in range(1, MAX_LEVEL + 1) for variant in range(3)}
    assert len(said) == 15 and instruction not in said
    for text in said:
        assert set(instruction.split()) - VERBS <= set(re.findall(r"\w+", text.lower())), text


def test_all_of_liberos_instructions_can_be_reworded(libero: Libero) -> None:
    instructions = instructions_of(libero)
    assert len(instructions) == 112  # of 130 tasks; some say the same in other scenes
    for instruction in instructions:
        for form in range(1, MAX_LEVEL + 1):
            for variant in range(len(FORMS[form - 1])):
                text = reworded(instruction, form, variant)
                assert set(instruction.split()) - VERBS <= set(re.findall(r"\w+", text.lower())), text


def test_what_is_picked_up_here_and_put_there_is_not_said_to_be_here_and_there() -> None:
    said = reworded("pick up the black bowl on the stove and place it on the plate", 4, 0)
    assert said == "Make sure that the black bowl on the stove has been put on the plate."
    assert reworded("put the white mug in the microwave and close it", 4, 2) == (
        "You are done when the white mug has been put in the microwave and the microwave is closed."
    )


def test_other_instructions_are_refused() -> None:
    for text in ("dance", "put the bowl", "paint the wall red"):
        with pytest.raises(ValueError, match="LIBERO"):
            orders_of(text)


def test_the_default_seed_of_lerobot_eval_starts_with_the_first_initial_state() -> None:
    assert [initial_state_of(seed, 50) for seed in (1000, 1001, 100_049)] == [0, 1, 49]


def test_an_episode_fails_in_one_way() -> None:
    wanted = {"bowl", "plate"}
    assert libero_failure_of(set(), wanted) is LiberoFailure.NEVER_TOUCHED
    assert libero_failure_of({"box"}, wanted) is LiberoFailure.WRONG_OBJECT
    assert libero_failure_of({"box", "bowl"}, wanted) is LiberoFailure.UNFINISHED


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (
            {"perturbations": ["goal:3"]},
            "'goal' is not an axis; choose one of: table, reflectance, distractors",
        ),
        ({"perturbations": []}, "names no condition"),
        ({"task": "libero_spacial"}, "--env.task"),
        ({"task_ids": [10]}, "libero_spatial has no task 10, only 0..9"),
        ({"task_ids": []}, "--env.task_ids=[] names no task"),
        ({"init_states": False}, "--env.init_states=false"),
        ({"is_libero_plus": True}, "--env.is_libero_plus=true"),
        ({"control_mode": "delta"}, "--env.control_mode"),
        *(
            (
                {"control_mode": "absolute", "perturbations": ["none", condition]},
                f"--env.perturbations={condition} with --env.control_mode=absolute",
            )
            for condition in ("dynamics:1", "camera:1+dynamics:2", "all:3")
        ),
        ({"episode_length": 0}, "--env.episode_length=0"),
    ],
)
def test_wrong_flags_are_named_before_anything_is_built(flags: dict, message: str) -> None:
    with pytest.raises(FlagError, match=re.escape(message)):
        BombLiberoEnvConfig(**flags)


def test_groups_of_results_name_suite_and_condition() -> None:
    config = BombLiberoEnvConfig(
        task="libero_spatial,libero_goal", perturbations=["none", "camera:2+light:3"]
    )
    assert [*config.groups] == [
        f"{suite}.{key}"
        for suite in ("libero_spatial", "libero_goal")
        for key in ("none", "camera-2.light-3")
    ]


def test_without_assets_the_folder_and_the_way_out_are_named(libero: Libero) -> None:
    with pytest.raises(ValueError, match=r"assets are missing.*hf download lerobot/libero-assets"):
        BombLiberoEnvConfig(task_ids=[0]).create_envs(1)


def test_a_sweep_without_libero_ends_before_it_begins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(Libero, "find", lambda: None)
    sweep = ["sweep", str(tmp_path / "s"), "--policies=bomb_expert", "--env.type=bomb_libero"]
    assert main(sweep) == 1
    assert "LIBERO is not installed: pip install" in capsys.readouterr().err
    assert not (tmp_path / "s").exists()
    assert main([*sweep, "--dry_run"]) == 0  # of jobs for another machine


def test_replay_names_the_command_that_films_the_episode(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "lines.jsonl"
    path.write_text(line(7, "light:3", False, task_id=2))
    assert main(["replay", str(path), "--line=1", f"--output={tmp_path / 'out'}"]) == 1
    said = capsys.readouterr().err
    flags = shlex.split(said[said.index("lerobot-eval") :])[1:]
    assert {"--env.type=bomb_libero", "--env.task_ids=[2]", "--seed=7"} < {*flags}
    assert '--env.perturbations=["light:3"]' in flags


def line(seed: int, condition: str, is_success: bool, task_id: int = 0) -> str:
    return LiberoResult(
        spec=LiberoSpec(seed, SUITES[0], task_id, None, condition),
        instruction="put the bowl on the plate",
        initial_state=seed % 50,
        steps=100,
        is_success=is_success,
        failure=None if is_success else LiberoFailure.UNFINISHED,
        levels={} if condition == "none" else {"light": 3},
    ).to_json()


def test_results_pool_tasks_and_pair_conditions(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "lines.jsonl"
    rows = [line(seed, "none", True, task) for seed in range(4) for task in (0, 2)]
    rows += [line(seed, "light:3", seed > 0, task) for seed in range(4) for task in (0, 2)]
    path.write_text("\n".join(rows))
    assert main(["results", "--strict", "--verbose", str(path)]) == 0
    text = capsys.readouterr().out
    assert "libero_spatial tasks 0, 2" in text and "robosuite" in text
    assert "success          6/8" in text and "unfinished 2" in text and "8 pairs, 2 lost, 0 won" in text


@pytest.mark.parametrize(
    ("field", "value"),
    [("failure", "tired"), ("initial_state", -1), ("image_size", 256), ("spec", {"seed": 0})],
)
def test_an_impossible_line_is_told(
    field: str, value: object, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    row = json.loads(line(0, "none", False)) | {field: value}
    path = tmp_path / "lines.jsonl"
    path.write_text(json.dumps(row))
    assert main(["results", "--strict", str(path)]) != 0
    assert field in capsys.readouterr().err


def test_the_axes_are_at_most_once_help_and_say_what_they_change() -> None:
    assert not any(axis.is_help for axis in LIBERO_AXES.values())
    assert {change for axis in LIBERO_AXES.values() for change in axis.changes} == {
        "images", "scene", "instruction", "dynamics",
    }  # fmt: skip
