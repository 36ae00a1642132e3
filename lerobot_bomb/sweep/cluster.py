"""Commands as jobs of a cluster: a SLURM array script, or through submitit."""

import shlex
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from submitit import Job

TIMEOUT_MIN = 24 * 60  # of a job; submitit's own default is 2 or 5, after which it is killed

_ARRAY = """\
#!/bin/bash
#SBATCH --job-name=lerobot-bomb
#SBATCH --array=0-{last}
# time, partition, GPUs: flags of sbatch, which stand in the command that submits this
cd {cwd} && exec {command} --shard="$SLURM_ARRAY_TASK_ID/{num_jobs}"
"""


def sbatch_script(command: Sequence[str], num_jobs: int, cwd: Path) -> str:
    """Return the script of a job array; each job runs the command with its `--shard`."""
    return _ARRAY.format(
        last=num_jobs - 1, cwd=shlex.quote(str(cwd)), command=shlex.join(command), num_jobs=num_jobs
    )


def submit(
    commands: Sequence[Sequence[str]], logs: Path, cluster: str | None, parameters: dict[str, Any]
) -> "list[Job[int]]":
    """Submit each command as a job of submitit's.

    Args:
        commands: run in the folder that this process is in.
        logs: folder for submitit's files.
        cluster: the name of an executor; None: submitit chooses.
        parameters: of submitit's AutoExecutor.

    Raises:
        RuntimeError: submitit is not installed, or the cluster refuses.
        ValueError: submitit knows no such cluster or parameter.
    """
    try:
        import submitit
    except ImportError as error:
        raise RuntimeError(
            "--submitit needs the package submitit: pip install 'lerobot_policy_bomb[submitit]'"
        ) from error
    executor = submitit.AutoExecutor(logs, cluster=cluster)
    try:
        executor.update_parameters(**{"name": "lerobot-bomb", "timeout_min": TIMEOUT_MIN} | parameters)
    except (AssertionError, NameError) as error:  # what submitit raises for wrong values and names
        raise ValueError(f"--submitit_parameters: {str(error).splitlines()[0]}") from None
    return executor.map_array(subprocess.check_call, commands)
