"""``lerobot-bomb export``: paper, model card and leaderboard say what the lines say."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from huggingface_hub import DatasetCard, ModelCardData, parse_eval_result_entries
from huggingface_hub.repocard_data import model_index_to_eval_results
from result_rows import FDVLA, old_row, read, row, values

from lerobot_bomb.bomb.perturbations import Condition
from lerobot_bomb.commands.main import main
from lerobot_bomb.hub.evaluations import model_index, model_index_yaml
from lerobot_bomb.report.eval_info import eval_info_files
from lerobot_bomb.results.groups import groups_of
from lerobot_bomb.results.origin import PolicyIdentity
from lerobot_bomb.results.reading import parse_record, read_records

SUCCESSES = {("act", "none"): 8, ("act", "all:1-5"): 3, ("fdvla", "none"): 9, ("fdvla", "all:1-5"): 0}
N = 10


@pytest.fixture
def rows() -> list[dict[str, Any]]:
    made = []
    for (policy, condition), successes in SUCCESSES.items():
        other = {"policy": FDVLA} if policy == "fdvla" else {}
        for seed in range(N):
            failure = None if seed < successes else "imprecise"
            made.append(values(seed, failure, 1.0, spec={"perturbations": condition}, **other))
    return made


@pytest.fixture
def exported(rows: list[dict[str, Any]], tmp_path: Path) -> Path:
    (tmp_path / "r.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    folder = tmp_path / "out"
    assert main(["export", str(tmp_path / "r.jsonl"), f"--output={folder}", "--benchmark_id=me/bomb"]) == 0
    return folder


def folder_of(exported: Path, policy: str) -> Path:
    (folder,) = (path for path in exported.iterdir() if path.is_dir() and path.name.startswith(policy))
    return folder


@pytest.mark.parametrize("policy", ["act", "fdvla"])
def test_the_hub_s_own_readers_find_the_rates_of_the_lines(exported: Path, policy: str) -> None:
    folder = folder_of(exported, policy)
    index = yaml.safe_load((folder / "model-index.yaml").read_text())["model-index"]
    name, results = model_index_to_eval_results(index)
    assert name == folder.name
    rates = {each.dataset_config: each.metric_value for each in results}
    entries = parse_eval_result_entries(
        yaml.safe_load((folder / ".eval_results" / "lerobot_bomb.yaml").read_text())
    )
    by_task = {each.task_id: each.value for each in entries}
    for condition, task in (("none", "place.none"), ("all:1-5", "place.all-1to5")):
        assert rates[task] == by_task[task] == SUCCESSES[policy, condition] / N
    assert {each.dataset_id for each in entries} == {"me/bomb"}
    assert all("95" not in str(each.value) and f"/{N} = " in str(each.notes) for each in entries)


def test_a_model_card_takes_the_same(rows: list[dict[str, Any]]) -> None:
    results = model_index(groups_of([read(row) for row in rows if row["policy"]["type"] == "act"]))
    card = ModelCardData(model_name="act", eval_results=results)
    assert [each["metrics"][0]["value"] for each in card.to_dict()["model-index"][0]["results"]] == [0.8, 0.3]


def test_policies_are_named_as_asked(rows: list[dict[str, Any]], tmp_path: Path) -> None:
    (tmp_path / "r.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    names = "--names=outputs/act=Ours,fdvla=Theirs"
    assert main(["export", str(tmp_path / "r.jsonl"), f"--output={tmp_path / 'out'}", names]) == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["Ours", "Theirs", "table.tex"]
    table = (tmp_path / "out" / "table.tex").read_text()
    assert r" & \multicolumn{3}{c}{Ours} & \multicolumn{3}{c}{Theirs} \\" in table


@pytest.mark.parametrize("names", ["act", "act=", "=x", "act=x,fdvla=x"])
def test_names_that_name_nothing_are_refused(names: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["export", "r.jsonl", f"--names={names}"])
    assert "must be POLICY=NAME, several joined by commas, each name once" in capsys.readouterr().err


def test_a_name_for_a_policy_that_is_not_there_is_refused(
    rows: list[dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "r.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert main(["export", str(tmp_path / "r.jsonl"), "--names=pi0=x", f"--output={tmp_path / 'o'}"]) == 1
    assert "--names: pi0 must name one policy of the file, not 0" in capsys.readouterr().err


def test_without_a_benchmark_of_the_hub_there_is_no_leaderboard_s_file(
    rows: list[dict[str, Any]], tmp_path: Path
) -> None:
    (tmp_path / "r.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert main(["export", str(tmp_path / "r.jsonl"), f"--output={tmp_path / 'out'}"]) == 0
    assert sorted(path.name for path in (tmp_path / "out").rglob("*.*") if path.is_file()) == [
        "model-index.yaml", "model-index.yaml", "table.tex",
    ]  # fmt: skip


def test_two_rates_for_one_condition_are_refused(
    rows: list[dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    others = [row | {"mujoco_version": "3.7.0"} for row in rows]
    (tmp_path / "r.jsonl").write_text("".join(json.dumps(row) + "\n" for row in [*rows, *others]))
    assert main(["export", str(tmp_path / "r.jsonl"), f"--output={tmp_path / 'out'}"]) == 1
    assert "has two rates for place, none: the episodes differ in MuJoCo" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def exported_rates(folder: Path) -> dict[str, float]:
    """{folder: the unperturbed rate} of all that was exported."""
    rates = {}
    for path in folder.rglob("model-index.yaml"):
        name, results = model_index_to_eval_results(yaml.safe_load(path.read_text())["model-index"])
        assert name == path.parent.name
        (rates[path.parent.relative_to(folder).as_posix()],) = (each.metric_value for each in results)
    return rates


@pytest.mark.parametrize("turn", [1, -1])
def test_names_that_resemble_each_other_are_folders_of_their_own(turn: int, tmp_path: Path) -> None:
    policies = [
        PolicyIdentity("act", path, None, weights * 64, "b" * 64)
        for path, weights in (("runs/v1.2", "a"), ("runs/v1", "b"), ("x/runs/v1", "c"), ("RUNS/v1", "d"))
    ][::turn]
    rates = {"a": 1.0, "b": 0.75, "c": 0.5, "d": 0.25}
    rows = [
        values(seed, None if seed < 4 * rates[str(policy.weights_sha256)[0]] else "dropped", policy=policy)
        for policy in policies
        for seed in range(4)
    ]
    (tmp_path / "r.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert main(["export", str(tmp_path / "r.jsonl"), f"--output={tmp_path / 'out'}"]) == 0
    found = exported_rates(tmp_path / "out")
    second = "act-RUNS-v1-2" if turn == 1 else "act-runs-v1-2"
    first = "act-runs-v1" if turn == 1 else "act-RUNS-v1"
    rates = {"act-runs-v1.2": 1.0, "act-x-runs-v1": 0.5, first: 0.75, second: 0.25}
    assert found == (rates if turn == 1 else rates | {first: 0.25, second: 0.75})


@pytest.mark.parametrize(
    ("named", "folder"),
    [
        ("..", "unnamed"),
        (".", "unnamed"),
        ("../../x", "x"),
        ("/etc/x", "etc-x"),
        (".hidden", "hidden"),
        ("é" * 300, "unnamed"),
    ],
)
def test_no_policy_s_name_leaves_the_folder(named: str, folder: str, tmp_path: Path) -> None:
    (tmp_path / "r.jsonl").write_text(json.dumps(values(0, policy=PolicyIdentity(named))) + "\n")
    out = tmp_path / "a" / "b"
    assert main(["export", str(tmp_path / "r.jsonl"), f"--output={out}"]) == 0
    assert exported_rates(out) == {folder: 1.0}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "r.jsonl"]
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["b"]


def test_a_policy_called_as_the_table_does_not_take_its_place(tmp_path: Path) -> None:
    (tmp_path / "r.jsonl").write_text(json.dumps(values(0, policy=PolicyIdentity("table.tex"))) + "\n")
    assert main(["export", str(tmp_path / "r.jsonl"), f"--output={tmp_path / 'out'}"]) == 0
    assert exported_rates(tmp_path / "out") == {"table.tex-2": 1.0}
    assert (tmp_path / "out" / "table.tex").is_file()


def test_a_benchmark_that_is_no_repository_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(["export", str(tmp_path / "r.jsonl"), "--benchmark_id=bomb"])
    assert "'bomb' must be USER/NAME" in capsys.readouterr().err


def test_rates_of_several_suites_stay_apart() -> None:
    rows = [
        values(0, failure, spec={"suite": suite})
        for suite, failure in (("place", None), ("object", "dropped"))
    ]
    index = yaml.safe_load(model_index_yaml("x", groups_of(map(read, rows))))["model-index"]
    _, results = model_index_to_eval_results(index)
    assert {each.dataset_config: each.metric_value for each in results} == {"place.none": 1, "object.none": 0}


def test_the_benchmark_s_dataset_names_the_tasks_of_the_results(exported: Path) -> None:
    folder = exported / "benchmark"
    evaluation = yaml.safe_load((folder / "eval.yaml").read_text())
    tasks = {each["id"] for each in evaluation["tasks"]}
    results = yaml.safe_load((folder_of(exported, "act") / ".eval_results" / "lerobot_bomb.yaml").read_text())
    assert tasks == {entry["dataset"]["task_id"] for entry in results}
    (config,) = DatasetCard((folder / "README.md").read_text()).data.to_dict()["configs"]
    (files,) = config["data_files"]
    assert {(each["config"], each["split"]) for each in evaluation["tasks"]} == {
        (config["config_name"], files["split"])
    }
    assert read_records(folder / files["path"]) == read_records(exported.parent / "r.jsonl")


@pytest.mark.parametrize("make", [row, old_row])
def test_the_benchmark_s_records_read_back(make: Callable[..., str], tmp_path: Path) -> None:
    lines = [make(seed, failure=failure).strip() for failure in ("dropped", None) for seed in range(4)]
    path = tmp_path / "r.jsonl"
    path.write_text("".join(f"{line}\n" for line in lines))
    flags = [f"--output={tmp_path / 'out'}", "--benchmark_id=me/bomb"]
    assert main(["export", str(path), str(path), *flags]) == 0
    records, damages = read_records(tmp_path / "out" / "benchmark" / "records.jsonl")
    assert (list(records.values()), damages) == ([parse_record(line.encode()) for line in lines[4:]], [])


def test_the_benchmark_names_the_versions_of_its_suites(tmp_path: Path) -> None:
    rows = [values(0), values(0, spec={"suite": "object"}, task_version="1.1", target=None)]
    (tmp_path / "r.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    flags = [f"--output={tmp_path / 'out'}", "--benchmark_id=me/bomb"]
    assert main(["export", str(tmp_path / "r.jsonl"), *flags]) == 0
    about = yaml.safe_load((tmp_path / "out" / "benchmark" / "eval.yaml").read_text())["description"]
    assert about.endswith("BOMB, task version 1.0; BOMB, task version 1.1.")


def test_tools_that_pair_by_seed_get_each_episode_and_what_it_is_of(
    exported: Path, rows: list[dict[str, Any]]
) -> None:
    folder = exported.parent / "paired"
    assert main(["export", str(exported.parent / "r.jsonl"), f"--output={folder}", "--eval_info"]) == 0
    for (policy, condition), successes in SUCCESSES.items():
        run = folder_of(folder, policy) / f"place.{Condition(condition).key}"
        info, meta = (json.loads((run / name).read_text()) for name in ("eval_info.json", "run_meta.json"))
        assert [(each["seed"], each["success"]) for each in info["per_episode"]] == [
            (seed, seed < successes) for seed in range(N)
        ]
        assert (meta["task"], meta["environment"], meta["policy_family"]) == (run.name, "bomb", policy)


def test_other_settings_are_another_checkpoint_id(tmp_path: Path) -> None:
    policies = [FDVLA, replace(FDVLA, settings_sha256="e" * 64), replace(FDVLA, path="elsewhere")]
    ids = [
        json.loads(eval_info_files(groups_of([read(values(0, policy=policy))]))["place.none/run_meta.json"])
        for policy in policies
    ]
    first, other, moved = (each["checkpoint_id"] for each in ids)
    assert first == moved != other


def test_numbered_tasks_are_exported_apart(tmp_path: Path) -> None:
    rows = [
        values(seed, None if task_id else "dropped", spec={"suite": "object", "task_id": task_id})
        for task_id in (0, 3)
        for seed in range(2)
    ]
    (tmp_path / "r.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert main(["export", str(tmp_path / "r.jsonl"), f"--output={tmp_path / 'out'}", "--eval_info"]) == 0
    for task, success in ((0, False), (3, True)):
        folder = tmp_path / "out" / "act" / f"object.none.task-{task}"
        info, meta = (json.loads((folder / name).read_text()) for name in ("eval_info.json", "run_meta.json"))
        assert [(each["seed"], each["success"]) for each in info["per_episode"]] == [
            (0, success),
            (1, success),
        ]
        assert meta["task"] == folder.name


@pytest.mark.parametrize("flag", ["--eval_info", "--benchmark_id=me/bomb"])
def test_policies_that_must_not_be_compared_are_refused(
    flag: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    hard = {"split": "heldout", "success_tolerance_mm": 20.0}
    rows = [values(0), values(0, policy=FDVLA, spec=hard)]
    (tmp_path / "r.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert main(["export", str(tmp_path / "r.jsonl"), f"--output={tmp_path / 'out'}"]) == 0
    assert main(["export", str(tmp_path / "r.jsonl"), f"--output={tmp_path / 'out'}", flag]) == 1
    assert "place.none of act and fdvla must not be compared: the episodes differ in split, succ" in (
        capsys.readouterr().err
    )
