"""Commands of the PushT benchmarks: convert, train and evaluate, each with a log of its own."""

import json
import os
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from lerobot_bomb.commands.run import run_command

REPO_ID = "lerobot_bomb/pusht"
MAX_COVERAGE_REWARD = 0.95  # coverage from which gym-pusht's reward is 1


@dataclass(frozen=True)
class Seconds:
    """Seconds that a training took, by the clock and of CPU."""

    clock: float
    cpu: float

    def on(self, device: str) -> float:
        """Return the seconds that count on a device: of CPU on a CPU, else by the clock."""
        return self.cpu if device == "cpu" else self.clock

    def minutes(self) -> dict[str, float]:
        """Return both in minutes, ready for JSON."""
        return {"minutes": self.clock / 60, "cpu_minutes": self.cpu / 60}


def convert(source: Path | None, dataset: Path, copies: int = 0) -> Path:
    """Convert the demonstrations, and so many rigid copies of each, to a LeRobotDataset in a folder."""
    if not dataset.exists():
        if source is None:
            raise RuntimeError(f"{dataset} does not exist yet; name the demonstrations with --source")
        resume = ["--resume"] if dataset.with_name(f"{dataset.name}.conversion").exists() else []
        flags = [f"--repo_id={REPO_ID}", f"--root={dataset}", f"--copies={copies}", *resume]
        run_command("lerobot-bomb", "convert", "pusht-zarr", str(source), *flags)
    return dataset


def train(output_dir: Path, flags: list[str]) -> Seconds:
    """Run stock `lerobot-train`; return the seconds that it took."""
    started = time.monotonic()
    cpu_s = run_logged(output_dir.with_suffix(".log"), "lerobot-train", *flags, f"--output_dir={output_dir}")
    return Seconds(time.monotonic() - started, cpu_s)


def evaluate(checkpoint: Path, output_dir: Path, flags: list[str]) -> tuple[list[float], int]:
    """Run stock `lerobot-eval --env.type=pusht`; return the episodes' maximal coverages and successes."""
    info = output_dir / "eval_info.json"
    if not info.exists():
        shutil.rmtree(output_dir, ignore_errors=True)
        stock = [f"--policy.path={checkpoint}", "--env.type=pusht", "--eval.use_async_envs=false"]
        log = output_dir.with_name("eval.log")
        run_logged(log, "lerobot-eval", *stock, *flags, f"--output_dir={output_dir}")
    metrics = [task["metrics"] for task in json.loads(info.read_text())["per_task"]]
    coverages = [MAX_COVERAGE_REWARD * reward for each in metrics for reward in each["max_rewards"]]
    return coverages, sum(sum(each["successes"]) for each in metrics)


def run_logged(log: Path, command: str, *flags: str) -> float:
    """Run a command of this Python's environment, log its output; return its processes' CPU seconds."""
    log.parent.mkdir(parents=True, exist_ok=True)
    print(f"{log.parent.name}: {command} {' '.join(flags[:2])} ... > {log}", flush=True)
    with log.open("w") as output:
        process = subprocess.Popen(
            [Path(sys.executable).with_name(command), *flags], stdout=output, stderr=output
        )
        _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(f"`{command}` ended with exit code {process.returncode}; see {log}")
    return usage.ru_utime + usage.ru_stime
