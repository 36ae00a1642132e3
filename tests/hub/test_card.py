"""Card of a checkpoint: what it says."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from bomb_pusht_cases import pusht_row
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from result_rows import old_row, read, values
from vla0_smol_cases import make_config

from hub.server import LoopbackHub
from lerobot_bomb.bomb.environment import Environment
from lerobot_bomb.data.facts import DatasetFacts
from lerobot_bomb.hub.card import Checkpoint, PolicyCard
from lerobot_bomb.results.bomb import EpisodeResult
from lerobot_bomb.results.reading import parse_record
from lerobot_policy_bomb.fdvla.card_fdvla import METHOD as FDVLA
from lerobot_policy_bomb.spatialvla_grid.card_spatialvla_grid import METHOD as GRID
from lerobot_policy_bomb.vla0_smol.card_vla0_smol import METHOD as VLA0

HUB_NAME = "HuggingFaceTB/SmolVLM2-500M-Video-Instruct"
INFO = {"total_episodes": 3, "total_frames": 60, "fps": 10}
BOMB_INFO = {
    **INFO,
    "robot_type": "bomb_fetch_v1.0",
    "features": {
        "observation.images.workspace": {"shape": [128, 128, 3]},
        "observation.images.wrist": {"shape": [128, 128, 3]},
        "observation.depth.wrist": {"shape": [128, 128]},
        "action": {"shape": [4], "names": ["x", "y", "z", "gripper"]},
    },
}
RECORDING: dict[str, Any] = {
    "task": "place",
    "robot": "fetch",
    "control_mode": "absolute",
    "fps": 10,
    "image_size": 128,
    "split": "train",
    "seed": 5,
    "task_ids": [],
    "perturbations": ["none", "camera:1-5"],
    "depth": True,
    "noise": 0.05,
    "protocol_version": "1.0",
    "package_version": "0.1.0",
}
TRAINING = TrainPipelineConfig(DatasetConfig("me/d"), steps=7)
BOMB = DatasetFacts(BOMB_INFO, {"recording": RECORDING, "num_episodes": 3, "failures": [{"seed": 6}]})


def checkpoint(name: str = HUB_NAME, **options: Any) -> Checkpoint:
    return Checkpoint(
        make_config(vlm_model_name=name, **options), VLA0, "me/x", TRAINING, on_hub=frozenset({"me/d"})
    )


def metadata(described: Checkpoint) -> dict[str, Any]:
    return yaml.safe_load(str(described.card()).split("---\n")[1])


def test_metadata_of_a_public_backbone() -> None:
    assert metadata(checkpoint()) == {
        "license": "apache-2.0",
        "library_name": "lerobot",
        "pipeline_tag": "robotics",
        "tags": ["lerobot", "lerobot_bomb", "robotics", "vla0_smol"],
        "model_name": "vla0_smol",
        "datasets": ["me/d"],
        "base_model": HUB_NAME,
    }


def test_adapters_name_the_checkpoint_that_they_are_of_and_not_its_backbone() -> None:
    hosted = metadata(replace(checkpoint(), adapters_of="me/whole"))
    assert (hosted["base_model"], hosted["base_model_relation"]) == ("me/whole", "adapter")
    local = metadata(replace(checkpoint("nano"), adapters_of="me/whole"))
    assert (local["base_model"], local["base_model_relation"]) == ("me/whole", "adapter")
    assert "base_model_relation" not in metadata(checkpoint())


@pytest.mark.parametrize(("name", "license"), [("nano", "apache-2.0"), ("/data/models/SmolVLM", None)])
def test_a_backbone_without_a_name_is_no_base_model(name: str, license: str | None) -> None:
    found = metadata(checkpoint(name))
    assert "base_model" not in found
    assert found.get("license") == license
    assert "/data" not in str(checkpoint(name).card())


def test_weights_keep_the_license_of_their_backbone() -> None:
    grid = replace(checkpoint(str(GRID.backbone)), method=GRID)
    fdvla = replace(checkpoint(str(FDVLA.backbone)), method=FDVLA)
    assert metadata(grid)["license"] == "gemma"
    assert (metadata(fdvla)["license"], metadata(fdvla)["license_name"]) == ("other", "qwen-research")
    assert metadata(replace(checkpoint(), license="mit"))["license"] == "mit"


def test_commands_are_those_of_the_training_and_of_what_the_dataset_shows(tmp_path: Path) -> None:
    training = TrainPipelineConfig(
        DatasetConfig("me/d", root=str(tmp_path), episodes=[0, 1]), batch_size=4, steps=7, seed=3
    )
    trained = replace(
        checkpoint(temporal_ensemble_size=0, trained_batches=7), training=training, dataset=BOMB
    )
    text = str(trained.card()).replace(" \\\n    ", " ")
    assert (
        "lerobot-train --policy.type=vla0_smol --policy.chunk_size=3 --policy.n_action_steps=2 "
        "--dataset.repo_id=me/d '--dataset.episodes=[0, 1]' --batch_size=4 --steps=7 --seed=3 "
        "--output_dir=outputs/vla0_smol\n"
    ) in text
    unseeded = replace(trained, training=replace(training, seed=None))
    assert " --seed=null " in str(unseeded.card())
    assert (
        "lerobot-eval --policy.path=me/x --env.type=bomb --env.task=place --env.robot=fetch "
        "--env.control_mode=absolute --env.fps=10 --env.image_size=128 --env.depth=true"
    ) in text
    assert "seeds 5..6; failed episodes that were left out: 1" in text  # 4 tried, 2 a seed
    assert "task version 1.0" in text
    assert str(tmp_path) not in text


def test_a_checkpoint_tells_its_environment_wherever_its_dataset_is() -> None:
    cameras = ("workspace", "wrist")
    environment = Environment("fetch", "absolute", 20, 64, cameras, "1.0", "place", task_ids=(7, 12))
    text = str(checkpoint(environment=environment).card()).replace(" \\\n    ", " ")
    assert (
        "--env.robot=fetch --env.control_mode=absolute --env.fps=20 --env.image_size=64 "
        "'--env.task_ids=[7,12]' "
    ) in text
    assert (
        "- environment: BOMB, task version 1.0, suite place, tasks [7, 12], robot fetch, control "
        "absolute at 20 Hz, cameras workspace, wrist of 64 px\n"
    ) in text
    assert "--policy.environment" not in text


def test_names_in_an_environment_are_no_markup() -> None:
    hostile = Environment("scara", "relative", 10, 64, ("a`</p><img src=x>\x1b[2J",), "1.0", "place")
    text = str(checkpoint(environment=hostile).card())
    assert r"cameras a\`&lt;/p&gt;&lt;img src=x&gt;\\x1b[2J of 64 px" in text


def test_a_suite_that_is_not_known_is_not_made_up() -> None:
    unknown = checkpoint(environment=Environment("scara", "relative", 10, 64, ("wrist",), "1.0"))
    text = str(unknown.card())
    assert "--env.task=SUITE" in text and "suite place" not in text and "task=place" not in text
    assert "`SUITE` is that of its training, which the dataset does not say." in text
    assert "- environment: BOMB, task version 1.0, an unknown suite, robot scara" in text
    result = read(values(0, spec={"suite": "object"}, task_version="1.1", target=None))
    card = str(replace(unknown, results=[[result]]).card())
    assert "--env.task=object" in card and "SUITE" not in card


@pytest.mark.parametrize(
    ("asked", "flag"),
    [
        ([{"target": [0, 1], "color": "black"}, {"target": [2, 3], "color": "white"}], "task_ids=[1,38]"),
        ([{"target": [0, 1], "color": None}], "target=[0,1]"),
        ([{"target": None, "color": "white"}], "color=white"),
        ([{"target": None, "color": None}], ""),
    ],
)
def test_an_evaluation_is_repeated_on_the_tasks_that_it_was_of(asked: list[dict], flag: str) -> None:
    records = [read(values(0, spec=each, image_size=64)) for each in asked]
    expected = ["--env.image_size=64", *([f"--env.{flag}"] if flag else [])]
    assert EpisodeResult.eval_flags(records)[5:] == expected


def test_an_evaluation_is_repeated_with_its_own_settings() -> None:
    spec = {"split": "heldout", "success_tolerance_mm": 20.0, "simulator": "sapien"}
    changed = read(values(0, spec=spec, sapien_version="3.0.0", render_preset="shadows"))
    flags = ["--env.split=heldout", "--env.success_tolerance_mm=20.0", "--env.simulator=sapien"]
    assert EpisodeResult.eval_flags([changed])[6:] == [*flags, "--env.render_preset=shadows"]
    unset = parse_record(old_row(0).encode())  # of a release that did not record the preset
    assert unset.eval_flags([unset])[6:] == []


def test_only_what_was_not_trained_is_said_to_be_a_start() -> None:
    text = "LeRobot has not trained it"
    assert text in str(checkpoint().card())
    assert text not in str(checkpoint(trained_batches=1).card())
    assert text not in str(replace(checkpoint(), adapters_of="me/base").card())


def test_pusht_and_datasets_of_others() -> None:
    pusht = DatasetFacts(INFO, {"conversion": {"source": "pusht-zarr 0123"}})
    assert "--env.type=pusht" in str(replace(checkpoint(), dataset=pusht).card())
    others = str(replace(checkpoint(), dataset=DatasetFacts(INFO, {})).card())
    assert "--env.type=ENV" in others
    assert "protocol" not in others


def test_an_evaluation_on_pusht_is_a_table_of_coverage_and_failures() -> None:
    outcomes = ((0.96, None), (0.5, "timeout"), (0.2, "timeout"), (0.1, "never_touched"))
    rows = [pusht_row(seed, "none", *outcome) for seed, outcome in enumerate(outcomes)]
    rows += [pusht_row(seed, "goal:3", 0.3, "turned_wrong") for seed in range(4)]
    pusht = DatasetFacts(INFO, {"conversion": {"source": "pusht-zarr 0123"}})
    records = [parse_record(json.dumps(row).encode()) for row in rows]
    text = str(replace(checkpoint(), dataset=pusht, results=[records]).card()).replace(" \\\n    ", " ")
    assert (
        "| condition | success (95 % Wilson interval) | max coverage (mean, 95 % bootstrap interval over "
        "episodes) | final coverage | failures |\n|---|---|---|---|---|\n"
        "| perturbations=none | 1/4 = 25.0 % [4.6, 69.9] | 0.440 ["
    ) in text
    assert " | timeout 2, never_touched 1 |\n| perturbations=goal:3 | 0/4 = 0.0 % [0.0, " in text
    assert " | 0.300 | 0.150 | turned_wrong 4 |" in text
    assert "task pusht; protocol pusht-1.0, instruction=none, max_steps=300, seeds 0..3; 96 px, gym-p" in text
    assert "Benchmark: PushT with BOMB's axes, protocol pusht-1.0." in text
    assert (
        "lerobot-eval --policy.path=me/x --env.type=bomb_pusht --env.instruction=none --env.max_steps=300 "
        "--env.image_size=96 --eval.n_episodes=200 --eval.batch_size=10 --env.results_path=results.jsonl\n"
        "lerobot-bomb results results.jsonl"
    ) in text


@pytest.mark.parametrize(("method", "source"), [(VLA0, "2510.13054"), (GRID, "2501.15830"), (FDVLA, "FDVLA")])
def test_the_method_is_cited(method: Any, source: str) -> None:
    assert source in str(replace(checkpoint(), method=method).card())


def test_a_dataset_is_named_as_one_of_the_hub_only_if_the_hub_has_it() -> None:
    local = replace(checkpoint(trained_batches=7), on_hub=frozenset())
    assert "datasets" not in metadata(local)
    text = str(local.card())
    assert "--dataset.repo_id=me/d" not in text
    assert text.count("--dataset.repo_id=USER/NAME") == 2
    assert "| `me/d`, a name on the machine of the training |" in text
    there = str(checkpoint(trained_batches=7).card())
    assert there.count("--dataset.repo_id=me/d") == 2
    assert "USER/NAME" not in there and "| `me/d` | not known |" in there


def test_random_weights_are_said_to_be_random() -> None:
    text = str(checkpoint("nano", trained_batches=7).card())
    assert "a small one, trained from random weights" in text
    assert "All weights were random before the first training." in text
    assert "a small one, of random weights" in str(checkpoint("nano").card())
    assert f"Before the first training, its vision-language model was `{HUB_NAME}`." in str(
        checkpoint(trained_batches=7).card()
    )


def test_the_card_says_what_the_checkpoint_cannot_do() -> None:
    nominal = DatasetFacts(BOMB_INFO, {**BOMB.bomb, "recording": RECORDING | {"perturbations": ["none"]}})
    trained = replace(checkpoint("nano", trained_batches=7), dataset=nominal, num_parameters=1234567)
    text = str(trained.card())
    for part in (
        "with 1,234,567 parameters",
        "- It acts only in the environment of its training: BOMB, task version 1.0, suite place, robot fetch",
        "- Its model is small and was never trained on anything else",
        "- No training showed it perturbed scenes.",
        "- How often it succeeds is not known: no evaluation is attached.",
        "nothing on a robot.",
    ):
        assert part in text
    assert "No training showed it" not in str(replace(trained, dataset=BOMB).card())
    assert "Its model is small" not in str(checkpoint(trained_batches=7).card())


def test_the_method_and_bomb_are_cited_as_the_citation_file_says() -> None:
    cited = yaml.safe_load((Path(__file__).parents[2] / "CITATION.cff").read_text())
    text = str(checkpoint().card())
    assert f"title = {{{{{cited['title']}}}}}" in text
    assert cited["authors"][0]["name"].replace("_", "\\_") in text
    assert f"version = {{{cited['version']}}}" in text


def test_the_hub_in_use_judges_the_metadata(online: LoopbackHub) -> None:
    checkpoint().card().validate()
    assert online.requests == ["POST /api/validate-yaml"]
    with pytest.raises(ValueError, match="no metadata"):
        PolicyCard("text").validate()
