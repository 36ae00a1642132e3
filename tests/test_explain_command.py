"""``lerobot-bomb explain``: pages of one episode and of several."""

import html
import json
from collections.abc import Callable
from pathlib import Path

import pytest
from explain_cases import end_episodes_after

from lerobot_bomb.bomb.board import HALVES
from lerobot_bomb.commands.explain import free_folder
from lerobot_bomb.commands.main import main

MAX_BYTES = 5e6  # of a page
MAX_STEPS = 28  # of an episode; the policies need fewer


@pytest.fixture(autouse=True)
def short_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    """End the episodes that a mask leads astray."""
    end_episodes_after(MAX_STEPS, monkeypatch)


@pytest.mark.one_type
def test_one_episode(policy_type: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "why"
    flags = [f"--policy.path=bomb:{policy_type}", "--seed=100000", "--grid=2", f"--output={output}"]
    assert main(["explain", *flags]) == 0
    printed = capsys.readouterr().out
    assert {path.name for path in output.iterdir()} == {
        "explanation.html",
        "explanation.json",
        "explanation.rrd",
    }
    found = json.loads((output / "explanation.json").read_text())
    phases = [moment["phase"] for moment in found["moments"]]
    assert phases == ["reach", "grasp", "carry", "place"]
    assert "\n".join(found["verdict"]) in printed and "It succeeded after" in found["verdict"][0]
    for moment in found["moments"]:
        assert {len(grid) for grid in moment["patches"].values()} == {2}
        assert moment["words"]["row and column"] is not None
        assert {len(each["mlps"]) for each in moment["restored"]} == {2}
        assert "pointing" not in moment and "It points at:" not in moment["findings"]
        assert {len(grid) for grid in moment["moved_mm"]["patches"].values()} == {2}
        assert moment["moved_mm"]["objects"].keys() == moment["objects"].keys()
    page = (output / "explanation.html").read_text()
    # the maps, and the filmstrip
    assert page.count("<img ") == 2 * len(phases) + 1 and "<script" not in page and len(page) < MAX_BYTES
    assert all(html.escape(sentence) in page for sentence in found["verdict"])
    assert "http" not in page.replace("http://www.w3.org/1999/xlink", "")
    masked = found["masked_episodes"]
    assert masked["nothing"]["is_success"] and not masked["the whole instruction"]["is_success"]
    assert {f"object: {name}" for name in HALVES} < masked.keys()
    # told of another place, it goes there
    assert {masked[f"another: {word}"]["failure"] for word in ("row", "column")} == {"wrong_intersection"}
    assert masked["nothing"] == found["result"] and found["counterfactuals"] == []
    assert len(found["gripper_xy_m"]) == found["result"]["steps"] + 1
    assert found["masked_paths"]["nothing"]["gripper_xy_m"] == found["gripper_xy_m"]


def test_the_default_folder_is_one_that_is_free(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for expected in ("explain", "explain-2", "explain-3"):
        folder = free_folder()
        assert folder == Path("outputs", expected)
        folder.mkdir(parents=True)


@pytest.mark.long
@pytest.mark.parametrize(
    ("number", "last"), [(2, "Where in the image"), (10, "Where is the destination known?")]
)
def test_several_episodes(number: int, last: str, tmp_path: Path) -> None:
    output = tmp_path / "why"
    flags = ["--policy.path=bomb:fdvla", "--seed=100000", "--grid=2", f"--output={output}"]
    assert main(["explain", *flags, f"--episodes={number}"]) == 0
    assert {path.name for path in output.iterdir()} == {"explanation.html", "explanation.json"}
    found = json.loads((output / "explanation.json").read_text())
    titles = [section["title"] for section in found["sections"]]
    assert titles[:2] == ["Verdict", "Effects"]
    named = {table["title"].partition(":")[0] for table in found["sections"][-1]["tables"]}
    assert named == {f"{phase}, {number} episodes" for phase in ("Reach", "Grasp", "Carry", "Place")}
    assert titles[-2:] == [last, "All numbers"] and len(found["episodes"]) == number
    assert found["verdict"][0].startswith(f"Success: {number}/{number} = 100.0 % [")
    assert "the stone (" in found["verdict"][1] and " mm [" in found["verdict"][1]
    moments = [moment for each in found["episodes"] for moment in each["moments"]]
    reached = [
        each["moved_mm"]["objects"]["all cameras"]["stone"] for each in moments if each["phase"] == "reach"
    ]
    drawn = {(row[0], row[1]): row[2] for row in found["sections"][1]["charts"][0]["tables"][0]["rows"]}
    assert drawn["reach", "stone"]["value"] == pytest.approx(sum(reached) / number)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--step=999"], "--step=999: the policy acted in steps 0 to"),
        (["--grid=5", "--step=0"], "--grid=5 does not divide an image of 64 x 64 pixels"),
        (["--words=white", "--step=0", "--color=black"], "the words 'white' are not in the instruction"),
        (["--fill=black", "--step=0"], "--fill"),
        (["--episodes=2", "--step=0"], "--step=0 is of one episode"),
        (["--episodes=0"], "--episodes=0 must be at least 1"),
    ],
)
def test_what_cannot_be_asked(
    flags: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "why"
    assert main(["explain", "--policy.path=bomb:fdvla", *flags, f"--output={output}"]) == 1
    assert message in capsys.readouterr().err
    assert not output.exists()


def test_a_folder_that_exists_is_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["explain", "--policy.path=bomb:fdvla", f"--output={tmp_path}"]) == 1
    assert "exists already" in capsys.readouterr().err


def test_the_episode_of_a_line(
    tmp_path: Path, stock_cli: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    results = tmp_path / "results.jsonl"
    stock_cli(
        "lerobot-eval", "--policy.path=bomb:fdvla", "--policy.device=cpu", "--env.type=bomb",
        "--env.image_size=64", "--env.perturbations=[\"light:3\"]", "--seed=100000", "--eval.n_episodes=1",
        "--eval.batch_size=1", f"--env.results_path={results}", f"--output_dir={tmp_path / 'eval'}",
    )  # fmt: skip
    row = json.loads(results.read_text())
    output = tmp_path / "why"
    # what is filled from another episode is hidden at this moment alone: no episode is run with a mask
    flags = [f"--results={results}", "--grid=2", "--step=3", "--fill=other", f"--output={output}"]
    assert main(["explain", *flags]) == 0
    found = json.loads((output / "explanation.json").read_text())
    assert found["moments"][0]["instruction"] == row["instruction"]
    assert found["result"]["spec"] == row["spec"] and found["recorded"] == row
    for wrong, message in (
        ("--line=2", "--line=2 is no episode of"),
        ("--line=0", "--line=0 is no episode of"),
        ("--perturbations=camera:3", "drop --env.perturbations: the record of --results says it"),
    ):
        assert main(["explain", *flags[:-1], wrong, f"--output={tmp_path / 'other'}"]) == 1
        assert message in capsys.readouterr().err
