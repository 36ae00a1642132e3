"""``lerobot-bomb replay``: a record's episode once more, bit for bit; and the same with another axis."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import pytest
from rrd_files import read_rrd

from lerobot_bomb.checkpoints.shipped import shipped_checkpoint
from lerobot_bomb.commands.arguments import ANSWER_IS_NO
from lerobot_bomb.commands.main import main
from lerobot_bomb.commands.results_files import read_record
from lerobot_bomb.conditions import NONE
from lerobot_bomb.results.bomb import EpisodeResult
from lerobot_bomb.results.record import ORIGIN
from lerobot_bomb.viewing.replay import Replay

FLAGS = ("--policy.num_inference_steps=3",)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """The file of results of two episodes by lerobot-eval, which are a batch unless said otherwise."""
    from lerobot_bomb.sweep.manifest import plan
    from lerobot_bomb.sweep.store import Store
    from lerobot_bomb.sweep.worker import Worker

    files: dict[Any, Path] = {}

    def evaluated(policy: str, *flags: str, condition: str = "all:1-5", batch_size: int = 2) -> Path:
        if (policy, flags, condition, batch_size) not in files:
            folder = tmp_path_factory.mktemp("sweep")
            shown = ("--env.type=bomb", "--env.image_size=64", "--policy.device=cpu", *flags)
            store = Store(folder, plan((policy,), (), (condition,), 7, 2, batch_size, shown))
            Worker(store).run(list(store.manifest.jobs))
            store.merge()
            files[policy, flags, condition, batch_size] = folder / "results.jsonl"
        return files[policy, flags, condition, batch_size]

    return evaluated


def rewritten(path: Path, file: Path, **changes: Any) -> Path:
    """Write the file's first line with other values."""
    values = json.loads(path.read_text().splitlines()[0])
    file.write_text(json.dumps(values | changes) + "\n")
    return file


@pytest.mark.parametrize(
    ("policy", "flags"),
    [
        ("bomb:fdvla", FLAGS),  # whose noise is a sequence that all episodes share
        pytest.param("bomb:vla0_smol", (), marks=pytest.mark.long),
        pytest.param("bomb:spatialvla_grid", (), marks=pytest.mark.long),
        pytest.param("bomb_random", ("--env.fps=2",), marks=pytest.mark.long),  # uses up an episode's 10 s
        ("bomb_expert", ()),
    ],
)
def test_a_record_is_run_again_bit_for_bit(
    policy: str,
    flags: tuple[str, ...],
    results: Callable[..., Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = results(policy, *flags)
    sizes = [json.loads(line)["policy"]["batch_row"] for line in path.read_text().splitlines()]
    assert sizes == [0, 1]
    is_timed = [bool(json.loads(line)["inference"]) for line in path.read_text().splitlines()]
    assert is_timed == [policy.startswith("bomb:")] * 2  # the replay is not, which makes no difference
    of_policy = [flag for flag in flags if flag.startswith("--policy.")]
    for line in (1, 2):
        output = f"--output={tmp_path / str(line)}"
        assert main(["replay", str(path), f"--line={line}", output, *of_policy]) == 0
        assert "as recorded, bit for bit: spec, is_success, failure, " in capsys.readouterr().out


def test_as_many_threads_compute_as_then(
    results: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Others would round sums otherwise."""
    import torch

    from lerobot_bomb.viewing.checkpoint import LoadedPolicy

    path = results("bomb:fdvla", *FLAGS)
    then = json.loads(path.read_text().splitlines()[0])["inference"]
    file = rewritten(path, tmp_path / "three.jsonl", inference=then | {"device": "cpu, 3 threads"})
    seen, act, before = set(), LoadedPolicy.act, torch.get_num_threads()

    def watched(loaded: LoadedPolicy, batch: dict[str, Any]) -> Any:
        seen.add(torch.get_num_threads())
        return act(loaded, batch)

    monkeypatch.setattr(LoadedPolicy, "act", watched)
    main(["replay", str(file), *FLAGS, f"--output={tmp_path / 'again'}"])
    assert seen == {3} and torch.get_num_threads() == before


def test_a_later_batch_draws_its_own_noise_again(
    results: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = (*FLAGS, "--policy.noise_per_episode=true")
    path = results("bomb:fdvla", *flags, condition=NONE, batch_size=1)
    assert main(["replay", str(path), "--line=2", f"--output={tmp_path / 'second'}", *flags]) == 0
    assert "as recorded, bit for bit" in capsys.readouterr().out


def test_flags_of_the_evaluation_are_given_again(
    results: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Check that they are asked for; with them, the record above is run again."""
    path = results("bomb:fdvla", *FLAGS)
    assert main(["replay", str(path), f"--output={tmp_path / 'x'}"]) == 1
    assert "other settings; give the flags --policy.NAME=VALUE" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "levels", ["camera:0,table:5", pytest.param("camera=0,table=5", marks=pytest.mark.long)]
)
def test_an_axis_is_changed_side_by_side(
    levels: str, results: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = results("bomb_expert", condition="camera:4+light:2")
    assert main(["replay", str(path), f"--output={tmp_path / 'x'}", f"--set={levels}"]) == 0
    out = capsys.readouterr().out
    assert "recorded (camera:4+light:2): " in out and "changed (table:5+light:2): " in out
    logged = read_rrd(tmp_path / "x.rrd")
    steps = json.loads(path.read_text().splitlines()[0])["steps"]
    for label in ("recorded", "changed"):
        assert len(logged[f"/{label}/camera/workspace"]) == steps + 1
    recorded, changed = (
        {entity: logged[f"/{label}/{entity}"][0] for entity in ("camera/workspace", "instruction")}
        for label in ("recorded", "changed")
    )
    blob, text = "EncodedImage:blob", "TextDocument:text"
    assert recorded["camera/workspace"][blob] != changed["camera/workspace"][blob]
    assert recorded["instruction"][text] == changed["instruction"][text]  # which no axis of these changes
    assert main(["replay", str(path), f"--output={tmp_path / 'alone'}"]) == 0
    sizes = []
    for name in ("x", "alone"):
        with av.open(str(tmp_path / f"{name}.mp4")) as file:
            sizes.append((file.streams.video[0].width, file.streams.video[0].height))
    assert sizes[0] == (2 * sizes[1][0], sizes[1][1])


def test_levels_that_were_drawn_stay_as_they_were(
    results: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = results("bomb_expert")
    levels = json.loads(path.read_text().splitlines()[0])["levels"]
    # all of them as they were drawn, by name: the same episode
    assert main(["replay", str(path), f"--output={tmp_path / 'x'}", f"--set=camera={levels['camera']}"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1] == lines[3]
    off = ",".join(f"{axis}=0" for axis in levels)
    assert main(["replay", str(path), f"--output={tmp_path / 'y'}", f"--set={off}"]) == 0
    assert f"changed ({NONE}): " in capsys.readouterr().out


def test_what_differs_first_is_told(
    results: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    changes = {"placement_error_mm": 3.5, "collateral_mm": 9.0, "torch_version": "2.0", "machine": "other"}
    path = rewritten(results("bomb_expert"), tmp_path / "changed.jsonl", **changes)
    assert main(["replay", str(path), f"--output={tmp_path / 'x'}"]) == ANSWER_IS_NO
    out = capsys.readouterr().out
    assert "not as recorded: placement_error_mm was 3.5 and is " in out
    assert "torch_version: 2.0 then, " in out and "machine: other then, " in out
    assert "lerobot_version" not in out


def test_other_weights_are_refused(
    results: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = results("bomb:fdvla", *FLAGS)
    policy = json.loads(path.read_text().splitlines()[0])["policy"]
    other = rewritten(path, tmp_path / "r.jsonl", policy=policy | {"weights_sha256": "0" * 64})
    assert main(["replay", str(other), f"--output={tmp_path / 'x'}"]) == 1
    assert "holds other weights than those of the record" in capsys.readouterr().err
    moved = rewritten(path, tmp_path / "m.jsonl", policy=policy | {"path": "gone"})
    assert main(["replay", str(moved), f"--output={tmp_path / 'x'}"]) == 1
    assert "--policy.path=gone: there is no such folder" in capsys.readouterr().err
    assert main(["replay", str(moved), f"--output={tmp_path / 'x'}", "--policy.path=bomb:fdvla", *FLAGS]) == 0


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--line=3"], "results.jsonl, whose lines are 1..2"),
        (["--line=0"], "--line=0 is no episode of"),
        (["--set=fog=3"], "--set: 'fog' is not an axis"),
        (["--set=camera=9"], "--set: the levels of camera must lie in 0..5"),
        (["--env.image_size=32"], "--env.image_size=32 is unknown"),
    ],
)
def test_wrong_flags_are_told(
    flags: list[str],
    message: str,
    results: Callable[..., Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["replay", str(results("bomb_expert")), f"--output={tmp_path / 'x'}", *flags]) == 1
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_line_is_that_of_an_editor(results: Callable[..., Path], tmp_path: Path) -> None:
    path, kept = tmp_path / "r.jsonl", results("bomb_expert").read_text().splitlines()
    path.write_text("\n".join([kept[0], kept[1][:40], "", kept[1], kept[0]]) + "\n")
    assert read_record(path, 1).to_json() == kept[0]
    assert read_record(path, 4).to_json() == kept[1]
    for line in (2, 3):
        with pytest.raises(ValueError, match=r", whose lines are 1, 4\.\.5"):
            read_record(path, line)


def test_a_policy_that_was_not_recorded_must_be_named(
    results: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = rewritten(results("bomb_expert"), tmp_path / "r.jsonl", policy=None)
    assert main(["replay", str(path), f"--output={tmp_path / 'x'}"]) == 1
    assert "does not name its policy; give --policy.path" in capsys.readouterr().err


def test_a_policy_with_random_weights_cannot_be_had_again(
    results: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    policy = json.loads(results("bomb_expert").read_text().splitlines()[0])["policy"] | {"type": "act"}
    path = rewritten(results("bomb_expert"), tmp_path / "r.jsonl", policy=policy)
    assert main(["replay", str(path), f"--output={tmp_path / 'x'}"]) == 1
    assert "act was built with random weights, which are in no file" in capsys.readouterr().err


def test_a_shipped_checkpoint_is_found_on_another_machine(
    results: Callable[..., Path], tmp_path: Path
) -> None:
    policy = json.loads(results("bomb_expert").read_text().splitlines()[0])["policy"]
    there = policy | {"path": "/elsewhere/lerobot_bomb/checkpoints/weights/fdvla"}
    path = rewritten(results("bomb_expert"), tmp_path / "r.jsonl", policy=there)
    assert Replay(read_record(path, 1)).checkpoint == shipped_checkpoint("fdvla")


def test_where_a_line_comes_from_is_named_by_its_fields() -> None:
    fields = set(EpisodeResult.__dataclass_fields__)
    assert ORIGIN - fields == {"simulator_versions"}  # of other environments
    assert {"spec", "steps", "failure", "placement_error_mm"} <= fields - ORIGIN
