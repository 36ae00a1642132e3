"""`record --shard`, `--join`: parts that processes record apart make the dataset of one process.

Simulator workers import this file's head, so LeRobot is imported inside tests.
"""

import shlex
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_record import misplace_white

from lerobot_bomb.commands.main import main
from lerobot_bomb.data import recording as recording_module
from lerobot_bomb.data import resumable
from lerobot_bomb.data.kept_blocks import finished_blocks, read_progress
from lerobot_bomb.data.parts import Part, join, record_part
from lerobot_bomb.data.record import record
from lerobot_bomb.data.recorded_blocks import BehaviorPolicy, EpisodeSource
from lerobot_bomb.data.recording import Recording
from lerobot_bomb.data.unfinished import METADATA_FILE, parts_folder

FLAGS = ("--repo_id=test/parts", "--episodes=7", "--seed=3", "--image_size=32", "--fps=5")
# seven episodes are three whole blocks of two and a short one
VIDEO = Recording("test/parts", episodes=7, seed=3, image_size=32, fps=5)
IMAGES = replace(VIDEO, images=True, pointing=True, task="all", protocol_version="", noise=0.01)
RELABELLED = replace(VIDEO, episodes=4, relabel="weights", images=True)


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks of 2 episodes, and 2 scenes an episode."""
    monkeypatch.setattr(resumable, "BLOCK_EPISODES", 2)
    monkeypatch.setattr(recording_module, "SCENES", 2)


def go_down(observation: dict[str, Any], instruction: str) -> np.ndarray:
    return np.array([0, 0, -0.1, 1], dtype=np.float32)


EXPERT = EpisodeSource()
HALF = EpisodeSource(expert=misplace_white)
OTHER = EpisodeSource(behavior=BehaviorPolicy(lambda number: None, go_down))


def contents(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recorded by one process, without failures."""
    root = tmp_path_factory.mktemp("whole") / "x"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(resumable, "BLOCK_EPISODES", 2)
        record(VIDEO, root)
    return root


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with both parts of VIDEO, finished, in x.parts."""
    folder = tmp_path_factory.mktemp("parts")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(resumable, "BLOCK_EPISODES", 2)
        for index in (1, 0):
            record_part(Part(VIDEO, index, 2), folder / "x", EXPERT)
    return folder


@pytest.fixture
def root(recorded: Path, tmp_path: Path) -> Path:
    """Return the place where a copy of these parts is to be joined."""
    shutil.copytree(recorded / "x.parts", tmp_path / "x.parts")
    return tmp_path / "x"


@pytest.mark.parametrize(
    ("recording", "source"),
    [
        pytest.param(VIDEO, HALF, id="video"),
        pytest.param(IMAGES, HALF, id="images", marks=pytest.mark.long),
        pytest.param(None, EXPERT, id="static"),
        pytest.param(RELABELLED, OTHER, id="relabelled", marks=pytest.mark.long),
    ],
)
def test_joined_parts_are_the_dataset_of_one_process(
    recording: Recording | None, source: EpisodeSource, tmp_path: Path
) -> None:
    if recording is None:  # four episodes of two scenes
        recording = Recording("test/parts", 0, static=8, task="spatial", image_size=32, images=True)
    at_once = record(recording, tmp_path / "whole", expert=source.expert, behavior=source.behavior)
    assert bool(at_once.failures) == (source is HALF)
    root = tmp_path / "x"
    made = [record_part(Part(recording, index, 2), root, source) for index in (1, 0)]
    assert all(made) and not root.exists()
    assert join(recording, root, source) == at_once
    assert contents(root) == contents(tmp_path / "whole")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["whole", "x"]


def test_parts_are_the_blocks_of_one_process_whoever_is_first(whole: Path, root: Path) -> None:
    parts = [Part(VIDEO, index, 2) for index in (0, 1)]
    assert [part.blocks for part in parts] == [range(1), range(1, 3)]
    names = [[block.name for block in finished_blocks(part.folder(root))] for part in parts]
    assert names == [["block-00000"], ["block-00001", "block-00002"]]
    assert main(["record", f"--root={root}", *FLAGS, "--join"]) == 0
    assert contents(root) == contents(whole)


def test_a_part_without_a_success_is_joined(tmp_path: Path) -> None:
    recording = replace(VIDEO, episodes=4, color="white")
    for index in (0, 1):
        made = record_part(Part(recording, index, 2), tmp_path / "x", HALF)
        assert made is not None and (made.num_episodes, len(made.failures)) == (0, 2)
    joined = join(recording, tmp_path / "x", EXPERT)
    assert (joined.num_episodes, [each["seed"] for each in joined.failures]) == (4, [3, 4, 5, 6])


def test_an_interrupted_part_goes_on(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from lerobot_bomb.data import blocks

    write, written = blocks._write_episode, iter(range(9))

    def write_three(*args: Any) -> None:
        if next(written) == 3:
            raise KeyboardInterrupt
        write(*args)

    flags = ["record", f"--root={tmp_path / 'x'}", *FLAGS, "--shard=1/2"]
    with monkeypatch.context() as patch:
        patch.setattr(blocks, "_write_episode", write_three)
        assert main(flags) == 130
    folder = parts_folder(tmp_path / "x") / "1-of-2.recording"
    assert f"2 episodes are kept in {folder}, continue with --resume" in capsys.readouterr().err
    assert [block.name for block in finished_blocks(folder)] == ["block-00001"]
    assert main(flags) == 0
    assert f"4 episodes, 55 frames, of the seeds 5..8: {folder}" in capsys.readouterr().out
    there = recorded / "x.parts" / "1-of-2.recording"
    blocks_there = {name: data for name, data in contents(there).items() if name.startswith("block")}
    assert {name: contents(folder)[name] for name in blocks_there} == blocks_there


def test_an_interrupted_join_goes_on(
    whole: Path, root: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from lerobot_bomb.data import blocks

    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    flags = ["record", f"--root={root}", *FLAGS, "--join"]
    with monkeypatch.context() as patch:
        patch.setattr(blocks, "merge_blocks", interrupted)
        assert main(flags) == 130
    assert "stopped; all parts stay, and the same command resumes" in capsys.readouterr().err
    kept = finished_blocks(root.with_name("x.recording"))
    assert [block.name for block in kept] == ["block-00003"]
    assert main([*flags[:-1], "--shard=1/2"]) == 0  # submitted again
    assert main(flags) == 0
    assert contents(root) == contents(whole)
    shutil.copytree(root, root.with_name("x.parts") / "1-of-2.recording")  # as a kill may leave it
    for again in ("--join", "--shard=0/2"):
        assert main([*flags[:-1], again]) == 0
    assert f"{root} is there, joined" in capsys.readouterr().out
    assert contents(root) == contents(whole)


def test_the_commands_of_a_job_array_record_the_dataset(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["record", "--root=a place", *FLAGS, "--slurm=2"]) == 0
    submit, joining = map(shlex.split, capsys.readouterr().out.splitlines())
    script = tmp_path / "a place.jobs" / "record.sbatch"
    assert submit == ["sbatch", str(script)]
    (line,) = [line for line in script.read_text().splitlines() if line.startswith("cd ")]
    assert "#SBATCH --array=0-1\n" in script.read_text()
    words = [word.replace("$SLURM_ARRAY_TASK_ID", "1") for word in shlex.split(line)]
    of_job = words[words.index("lerobot_bomb.commands.main") + 1 :]
    assert of_job[-1] == "--shard=1/2"
    for flags in (of_job, [*of_job[:-1], "--shard=0/2"], joining[joining.index("record") :]):
        assert main(flags) == 0
    assert contents(tmp_path / "a place") == contents(whole)


def test_a_jobs_command_has_all_flags(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = [
        "--repo_id=test/parts", "--static=4", "--task=spatial", "--seed=5", "--task_ids=[1,2]", "--images",
        '--perturbations=["camera:2+light:3","all:1-5"]', "--success_tolerance_mm=9.5", "--workers=2",
    ]  # fmt: skip
    assert main(["record", f"--root={tmp_path / 'x'}", *given, "--slurm=1"]) == 0
    script = (tmp_path / "x.jobs" / "record.sbatch").read_text()
    flags = shlex.split(script)[shlex.split(script).index("record") + 1 : -1]
    assert {
        "--static=4", "--task=spatial", "--seed=5", "--task_ids=1,2", "--images=true", "--workers=2",
        "--perturbations=camera:2+light:3,all:1-5", "--success_tolerance_mm=9.5", f"--root={tmp_path / 'x'}",
    } < set(flags)  # fmt: skip


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--shard=2/2"], "--shard: 2/2 must be PART/PARTS, the parts counted from 0"),
        (["--shard=half"], "--shard: half must be PART/PARTS"),
        (["--shard=0/4"], "--shard=0/4: a part has at least 2 episodes, and 7 make 3 parts at most"),
        (["--slurm=0"], "--slurm=0 must be from 1 to the number of parts of at least 2 episodes, 3"),
        (["--submitit=4"], "--submitit=4 must be from 1 to the number of parts of at least 2 episodes, 3"),
        (["--submitit_cluster=local"], "--submitit_cluster and --submitit_parameters need --submitit=N"),
        (["--join"], "x.parts holds no parts; record them with --shard=0/N"),
    ],
)
def test_wrong_parts_are_told(
    flags: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["record", f"--root={tmp_path / 'x'}", *FLAGS, *flags]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--shard=0/3"], "--shard=0/3: {parts} holds parts of 2; give --shard=I/2, or another --root"),
        (
            ["--seed=4", "--shard=0/2"],
            "--shard=0/2: the recording in {parts}/0-of-2.recording differs in seed=4",
        ),
        (["--seed=4", "--join"], "--join: the recording in {parts}/0-of-2.recording differs in seed=4"),
        (["--episodes=9", "--join"], "differs in episodes=9 (it has 7)"),
        (["--episodes=3", "--join"], "differs in episodes=3 (it has 7)"),
        ([], "{parts} holds parts of a recording, of --shard; join them with --join"),
        (["--resume"], "{parts} holds parts of a recording, of --shard; join them with --join"),
    ],
)
def test_parts_of_another_recording_are_told(
    flags: list[str], message: str, root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = contents(root.parent)
    assert main(["record", f"--root={root}", *FLAGS, *flags]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert message.format(parts=f"{root}.parts") in line
    assert contents(root.parent) == before


def test_missing_and_damaged_parts_are_named_and_recorded_again(
    whole: Path, root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    parts = parts_folder(root)
    shutil.rmtree(parts / "0-of-2.recording")
    info = parts / "1-of-2.recording" / "block-00002" / "meta" / "info.json"
    info.write_bytes(info.read_bytes()[:50])
    flags = ["record", f"--root={root}", *FLAGS]
    assert main([*flags, "--join"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    damage = "0/2 (block-00000 is missing), 1/2 (block-00002 holds a damaged meta/info.json)"
    assert line.endswith(
        f"--join: {parts} lacks parts, or blocks of them: {damage}; record them with --shard=0/2 --shard=1/2"
    )
    for each in ("--shard=0/2", "--shard=1/2", "--join"):
        assert main([*flags, each]) == 0
    assert contents(root) == contents(whole)


def test_parts_of_two_divisions_are_not_joined(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(
        root.with_name("x.parts") / "0-of-2.recording", root.with_name("x.parts") / "0-of-3.recording"
    )
    assert main(["record", f"--root={root}", *FLAGS, "--join"]) == 1
    assert "x.parts holds parts of 2 and of 3; delete those of one" in capsys.readouterr().err


def test_a_recording_that_was_begun_at_once_takes_no_parts(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    begun, parts = root.with_name("x.recording"), root.with_name("x.parts")
    shutil.copytree(parts / "0-of-2.recording", begun)
    message = (
        f"{begun} holds a recording that was begun without --shard; resume without it, give another --root"
    )
    assert main(["record", f"--root={root}", *FLAGS, "--join"]) == 1
    assert f"--join: {message}" in capsys.readouterr().err
    shutil.rmtree(parts)
    assert main(["record", f"--root={root}", *FLAGS, "--shard=0/2"]) == 1
    assert f"--shard=0/2: {message}" in capsys.readouterr().err
    assert not parts.exists()


def test_a_dataset_that_lies_in_parts_is_told(root: Path) -> None:
    from lerobot_bomb.data.missing import describe_missing_dataset

    said = describe_missing_dataset("test/parts", root, FileNotFoundError())
    assert said == (
        f"the recording {root} lies in parts ({root}.parts): join them with `lerobot-bomb record ... --join`"
    )


@pytest.mark.long
def test_submitits_jobs_record_and_join(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run them in processes of their own, whose blocks are of 20 episodes."""
    monkeypatch.setattr(resumable, "BLOCK_EPISODES", 20)
    flags = ["record", f"--root={tmp_path / 'x'}", *FLAGS[:1], "--episodes=40", *FLAGS[2:]]
    jobs = ["--submitit=2", "--submitit_cluster=local", '--submitit_parameters={"timeout_min": 20}']
    assert main([*flags, *jobs]) == 0
    record(replace(VIDEO, episodes=40), tmp_path / "whole")
    assert contents(tmp_path / "x") == contents(tmp_path / "whole")
    assert read_progress(tmp_path / "x" / METADATA_FILE).num_episodes == 40
    assert not (tmp_path / "x.parts").exists()
