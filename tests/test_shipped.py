"""The checkpoints that come with the package: what they are called, and that they place stones."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from lerobot.configs import PreTrainedConfig, parser
from lerobot.utils.import_utils import register_third_party_plugins
from recipes import read_recipe, recipe_path

from lerobot_bomb.checkpoints.identity import sha256_of
from lerobot_bomb.checkpoints.names import CONFIG, TRAIN_CONFIG, WEIGHTS, has_local_path
from lerobot_bomb.checkpoints.shipped import FOLDER, checkpoint_path, shipped_names
from lerobot_bomb.commands import demo
from lerobot_bomb.commands.main import main
from lerobot_bomb.results.bomb import EpisodeResult
from lerobot_bomb.results.groups import read_results

Run = Callable[..., None]
NAMES = shipped_names()
MAX_MB = 24
RESULTS = Path(__file__).parents[1] / "docs" / "results.md"


@pytest.fixture(scope="module", autouse=True)
def plugin() -> None:
    register_third_party_plugins()


def test_they_are_small_whole_and_of_this_machine_only_by_name() -> None:
    assert demo.POLICY in NAMES
    assert sum(path.stat().st_size for path in FOLDER.rglob("*") if path.is_file()) < MAX_MB * 1e6
    for name in NAMES:
        found = {path.name for path in (FOLDER / name).iterdir()}
        assert {CONFIG, TRAIN_CONFIG, WEIGHTS} <= found
        assert {Path(file).suffix for file in found} == {".json", ".safetensors"}
        for file in (CONFIG, TRAIN_CONFIG):
            assert not has_local_path(json.loads((FOLDER / name / file).read_text()))


@pytest.mark.parametrize("name", NAMES)
def test_its_name_begins_with_its_type_and_the_page_of_results_has_its_hash(name: str) -> None:
    assert name.removesuffix("_suites") == PreTrainedConfig.from_pretrained(FOLDER / name).type
    assert f"`{sha256_of(FOLDER / name / WEIGHTS)}`" in RESULTS.read_text()


@pytest.mark.parametrize("name", NAMES)
def test_lerobot_eval_takes_the_name_and_it_places_stones(name: str, stock_cli: Run, tmp_path: Path) -> None:
    results = tmp_path / "results.jsonl"
    stock_cli(
        "lerobot-eval",
        f"--policy.path=bomb:{name}",
        "--policy.device=cpu",
        "--env.type=bomb",
        f"--env.results_path={results}",
        "--eval.n_episodes=6",
        "--eval.batch_size=6",
        "--eval.use_async_envs=false",
        f"--output_dir={tmp_path / 'eval'}",
    )
    assert sum(row.is_success for row in read_results(results)) >= 5


def test_another_environment_is_refused_with_the_flag_to_give(stock_cli: Run, tmp_path: Path) -> None:
    flags = "--env.type=bomb --env.image_size=96 --eval.n_episodes=1 --eval.batch_size=1"
    flags += " --eval.use_async_envs=false"
    with pytest.raises(ValueError, match=r"--env\.image_size=64"):
        stock_cli(
            "lerobot-eval", f"--policy.path=bomb:{demo.POLICY}", *flags.split(), f"--output_dir={tmp_path}"
        )


def test_lerobot_train_goes_on_from_it_by_a_config_file(
    stock_cli: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for read_before in ("_config_path_args", "_config_yaml_overrides"):  # LeRobot keeps them in the process
        monkeypatch.setattr(parser, read_before, {})
    root = tmp_path / "dataset"
    record = f"record --repo_id=test/more --root={root} --episodes=1 --image_size=64 --images"
    assert main(record.split()) == 0
    recipe, config = recipe_path("robust", "fdvla"), tmp_path / "further.yaml"
    start = read_recipe("robust", "fdvla")["policy"]["path"]
    config.write_text(recipe.read_text().replace(start, "bomb:fdvla"))
    stock_cli(
        "lerobot-train",
        f"--config_path={config}",
        "--dataset.repo_id=test/more",
        f"--dataset.root={root}",
        "--steps=1",
        "--batch_size=2",
        "--num_workers=0",
        f"--output_dir={tmp_path / 'train'}",
    )
    trained = tmp_path / "train" / "checkpoints" / "last" / "pretrained_model"
    assert sha256_of(trained / WEIGHTS) != sha256_of(FOLDER / "fdvla" / WEIGHTS)


def test_an_unknown_name_is_one_line_with_the_names(
    stock_cli: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match=rf"--policy\.path=bomb:nobody: no .*: .*{demo.POLICY}"):
        stock_cli("lerobot-eval", "--policy.path=bomb:nobody", "--env.type=bomb")
    assert main(["checkpoint", "path", "nobody"]) == 1
    assert demo.POLICY in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["view", "--policy.path=bomb:nobody"])
    assert demo.POLICY in capsys.readouterr().err


def test_the_command_prints_a_folder_or_all(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["checkpoint", "path", demo.POLICY]) == 0
    assert Path(capsys.readouterr().out.strip()) == FOLDER / demo.POLICY
    assert main(["checkpoint", "path"]) == 0
    assert capsys.readouterr().out.split()[::2] == [f"bomb:{name}" for name in NAMES]
    assert checkpoint_path("some/folder") == "some/folder"


@pytest.mark.long
def test_the_demo_ends_with_rates_films_and_a_page(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "demo"
    assert main(["demo", "--episodes=1", f"--output_dir={folder}"]) == 0
    printed = capfd.readouterr().out
    assert f"report  {folder / 'report.html'}" in printed
    records = read_results(folder / "results.jsonl", EpisodeResult)
    assert {each.spec.suite for each in records} == set(demo.SUITES)
    assert {each.spec.perturbations for each in records} == set(demo.CONDITIONS)
    experts = [each for each in records if each.policy is not None and each.policy.type == "bomb_expert"]
    assert len(records) == 2 * len(experts)
    assert all(each.is_success for each in experts)
    assert ("There is no failure." in printed) != (folder / "failure.mp4").is_file()
    assert (folder / "success.mp4").stat().st_size > 1000
    assert main(["demo", f"--output_dir={folder}"]) == 1
