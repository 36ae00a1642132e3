"""``lerobot-bomb sweep`` over GPUs and clusters: whoever runs the jobs, the records are the same."""

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from lerobot_bomb.commands import cluster_jobs
from lerobot_bomb.commands import sweep as sweep_command
from lerobot_bomb.commands.main import main
from lerobot_bomb.sweep import cluster, local
from lerobot_bomb.sweep.cluster import sbatch_script
from lerobot_bomb.sweep.manifest import plan
from lerobot_bomb.sweep.processes import visible_gpus, worker_environments
from lerobot_bomb.sweep.store import Store

FAKE_SLURM = Path(__file__).parent / "fixtures" / "slurm"
FLAGS = ("--env.type=bomb", "--env.image_size=32", "--policy.device=cpu")
CONDITIONS = ("none", "light:3")
SWEEP = (
    "--policies=bomb_expert",
    f"--perturbations={','.join(CONDITIONS)}",
    "--episodes=2",
    "--seed=7",
    *FLAGS,
)


def sweep(*flags: str | Path) -> int:
    return main(["sweep", *map(str, flags)])


@pytest.fixture(scope="module")
def expected_lines(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the lines of all jobs, run in this process."""
    from lerobot_bomb.sweep.worker import Worker

    manifest = plan(("bomb_expert",), (), CONDITIONS, seed=7, num_episodes=2, batch_size=2, flags=FLAGS)
    store = Store(tmp_path_factory.mktemp("sweep"), manifest)
    Worker(store).run(list(manifest.jobs))
    store.merge()
    return (store.folder / "results.jsonl").read_text()


@pytest.fixture
def jobs(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Let workers and jobs run in this process, as each of their own imports LeRobot; return the commands."""
    from lerobot_bomb.sweep.worker import Worker

    commands = []

    def run_part(store: Store, part: str, *_: Any) -> None:
        Worker(store).run(list(store.manifest.part(part)))

    def run_job(command: Sequence[str]) -> int:
        assert command[: len(local.PYTHON) + 1] == [*local.PYTHON, "lerobot_bomb.commands.main"]
        commands.append(list(command))
        return main(command[len(local.PYTHON) + 1 :])

    monkeypatch.setattr(sweep_command, "run_part", run_part)
    monkeypatch.setattr(cluster.subprocess, "check_call", run_job)
    return commands


# GPUs


@pytest.mark.parametrize(
    ("named", "gpus"),
    [
        ("0", ["0"]),
        ("4,7", ["4", "7"]),
        ("GPU-8f1c,MIG-2a", ["GPU-8f1c", "MIG-2a"]),
        ("", []),
        ("-1", []),
        ("0,-1,1", ["0"]),
        (None, ["0", "1", "2"]),
    ],
)
def test_gpus_are_those_named_or_all_of_the_driver(
    named: str | None, gpus: list[str], tmp_path: Path
) -> None:
    for name in ("0000:1a:00.0", "0000:3d:00.0", "0000:5e:00.0"):
        (tmp_path / name).mkdir()
    environment = {} if named is None else {"CUDA_VISIBLE_DEVICES": named}
    assert visible_gpus(environment, driver=tmp_path) == gpus


def test_without_a_driver_there_are_no_gpus(tmp_path: Path) -> None:
    assert visible_gpus({}, driver=tmp_path / "gpus") == []


def test_workers_take_gpus_in_turn_and_share_the_cores() -> None:
    environment = {"HOME": "/home", "CUDA_VISIBLE_DEVICES": "4,7"}
    assert worker_environments(3, environment, cores=8, gpus=["4", "7"]) == [
        {"HOME": "/home", "OMP_NUM_THREADS": "2", "CUDA_VISIBLE_DEVICES": "4"},
        {"HOME": "/home", "OMP_NUM_THREADS": "2", "CUDA_VISIBLE_DEVICES": "7"},
        {"HOME": "/home", "OMP_NUM_THREADS": "2", "CUDA_VISIBLE_DEVICES": "4"},
    ]
    assert worker_environments(1, {"OMP_NUM_THREADS": "3"}, cores=8, gpus=[]) == [{"OMP_NUM_THREADS": "3"}]
    assert worker_environments(4, {}, cores=2, gpus=[])[3] == {"OMP_NUM_THREADS": "1"}


def test_workers_that_end_at_once_are_started_anew_on_their_gpus_and_then_no_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4,7")
    # a line in one write: both workers write to one file
    ending = (sys.executable, "-c", "import os; os.write(1, os.environb[b'CUDA_VISIBLE_DEVICES'] + b'\\n')")
    monkeypatch.setattr(local, "PYTHON", ending)
    assert sweep(tmp_path, "--workers=2", *SWEEP) == 1
    log = (tmp_path / "workers.log").read_text().split()
    assert set(log) == {"4", "7"} and log.count("4") >= 3 and log.count("7") >= 3
    assert "workers end before they run" in capsys.readouterr().err


# SLURM


def test_a_job_of_the_script_runs_its_part_where_the_script_was_written(tmp_path: Path) -> None:
    here = tmp_path / "it's here"
    here.mkdir()
    script = tmp_path / "sweep.sbatch"
    script.write_text(
        sbatch_script(["bash", "-c", 'printf "%s\n" "$PWD" "$@"', "name", "two words"], 3, here)
    )
    subprocess.run(["bash", "-n", script], check=True)
    job = os.environ | {"SLURM_ARRAY_TASK_ID": "2"}
    printed = subprocess.run(["bash", script], env=job, check=True, capture_output=True, text=True).stdout
    assert printed.splitlines() == [str(here), "two words", "--shard=2/3"]
    assert "#SBATCH --array=0-2\n" in script.read_text()


def submit(printed: str) -> None:
    """Do what a user does with the line that `--slurm` prints."""
    path = f"{FAKE_SLURM}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-c", printed], env=os.environ | {"PATH": path}, capture_output=True, text=True
    )
    assert done.stdout == "Submitted batch job 1\n", done.stderr


@pytest.mark.long
def test_commands_of_a_slurm_script_run_everything(
    expected_lines: str,
    jobs: list[list[str]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(sweep_command, "PYTHON", ("printf", r"%s\0"))  # each job prints its arguments
        assert sweep("it's a sweep", "--slurm=2", *SWEEP) == 0
    (printed,) = capsys.readouterr().out.splitlines()
    submit(printed)
    for number, said in enumerate(("2 of 4 episodes, 1 of 2 jobs", "4 of 4 episodes, 2 of 2 jobs")):
        name, *arguments = (tmp_path / f"slurm-1_{number}.out").read_text().split("\0")[:-1]
        assert name == "lerobot_bomb.commands.main"
        assert main(arguments) == 0
        assert said in capsys.readouterr().out
    assert (tmp_path / "it's a sweep" / "results.jsonl").read_text() == expected_lines
    assert jobs == []


@pytest.mark.long
def test_the_slurm_script_gives_the_lines_of_one_process(
    expected_lines: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert sweep("it's a sweep", "--slurm=2", *SWEEP) == 0
    subprocess.run(["bash", "-n", tmp_path / "it's a sweep" / "sweep.sbatch"], check=True)
    (printed,) = capsys.readouterr().out.splitlines()
    submit(printed)
    assert (tmp_path / "it's a sweep" / "results.jsonl").read_text() == expected_lines
    assert "2 of 4 episodes, 1 of 2 jobs" in (tmp_path / "slurm-1_0.out").read_text()
    assert "4 of 4 episodes, 2 of 2 jobs" in (tmp_path / "slurm-1_1.out").read_text()


# submitit


def submitit(cluster: str) -> tuple[str, ...]:
    return "--submitit=2", f"--submitit_cluster={cluster}", '--submitit_parameters={"timeout_min": 10}'


def test_submitits_jobs_run_everything_once(
    expected_lines: str, jobs: list[list[str]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "a sweep"
    for flags in (SWEEP, ()):  # nothing is left to be run
        assert sweep(folder, *submitit("debug"), *flags) == 0
        assert (folder / "results.jsonl").read_text() == expected_lines
        assert [job[-1] for job in jobs] == ["--shard=0/2", "--shard=1/2"]
        assert "4 of 4 episodes, 2 of 2 jobs" in capsys.readouterr().out


@pytest.mark.long
def test_submitits_jobs_give_the_lines_of_one_process(expected_lines: str, tmp_path: Path) -> None:
    folder = tmp_path / "a sweep"
    assert sweep(folder, *submitit("local"), *SWEEP) == 0
    assert (folder / "results.jsonl").read_text() == expected_lines
    assert len(list((folder / "submitit").glob("*_submitted.pkl"))) == 2


class Job:
    """One of submitit's that never runs."""

    def __init__(self, is_done: bool) -> None:
        self.is_done, self.is_cancelled = is_done, False

    def done(self) -> bool:
        return self.is_done

    def wait(self) -> None:
        assert self.is_done

    def cancel(self, check: bool) -> None:
        self.is_cancelled = True


def test_jobs_that_end_before_they_run_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cluster_jobs, "submit", lambda *args: [Job(is_done=True)])
    assert sweep(tmp_path, "--submitit=1", *SWEEP) == 1
    printed = capsys.readouterr().out
    assert f"cluster jobs ended before everything was run; {tmp_path / 'submitit'} says why" in printed
    assert "0 of 4 episodes" in printed


def test_ctrl_c_cancels_the_jobs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(seconds: float) -> None:
        raise KeyboardInterrupt

    job = Job(is_done=False)
    monkeypatch.setattr(cluster_jobs, "submit", lambda *args: [job])
    monkeypatch.setattr(time, "sleep", interrupted)
    assert sweep(tmp_path, "--submitit=1", *SWEEP) == 130
    printed = capsys.readouterr()
    assert job.is_cancelled and "to resume: " in printed.out and "interrupted" in printed.err


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--workers=0"], "--workers=0 must be at least 1"),
        (["--slurm=0"], "--slurm=0 must be from 1 to the number of jobs, 2"),
        (["--submitit=3"], "--submitit=3 must be from 1 to the number of jobs, 2"),
        (["--submitit_cluster=local"], "--submitit_cluster and --submitit_parameters need --submitit=N"),
        (["--submitit=1", "--submitit_cluster=fog"], "doesn't know any executor named fog"),
        (
            ["--submitit=1", "--submitit_cluster=local", '--submitit_parameters={"fog": 1}'],
            "--submitit_parameters: Parameter 'fog' need to be prefixed by an executor name",
        ),
        (
            ["--submitit=1", "--submitit_cluster=local", '--submitit_parameters={"timeout_min": "long"}'],
            '--submitit_parameters: Parameter "timeout_min" expected type',
        ),
    ],
)
def test_wrong_flags_are_told_in_a_line(
    flags: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert sweep(tmp_path, *flags, *SWEEP) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--slurm=1", "--submitit=1"], "--submitit: not allowed with argument --slurm"),
        (["--slurm=1", "--shard=0/2"], "--shard: not allowed with argument --slurm"),
        (
            ["--submitit=1", "--submitit_parameters=gpus"],
            "--submitit_parameters: 'gpus' must be a JSON object",
        ),
        (["--submitit=1", "--submitit_parameters=[1]"], "--submitit_parameters: '[1]' must be a JSON object"),
    ],
)
def test_flags_that_cannot_be_read_are_told(
    flags: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        sweep(tmp_path, *flags, *SWEEP)
    assert message in capsys.readouterr().err.splitlines()[-1]


def test_without_submitit_the_way_out_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    modules: dict[str, Any] = sys.modules
    monkeypatch.setitem(modules, "submitit", None)
    assert sweep(tmp_path, "--submitit=1", *SWEEP) == 1
    message = "--submitit needs the package submitit: pip install 'lerobot_policy_bomb[submitit]'"
    assert capsys.readouterr().err == f"lerobot-bomb sweep: {message}\n"
