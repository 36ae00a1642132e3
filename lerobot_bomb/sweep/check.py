"""Check of a sweep before it begins, for errors that would come in the middle."""

import logging
from collections.abc import Sequence

from lerobot_bomb.checkpoints.acting import acting
from lerobot_bomb.compat.own.evaluation import eval_config
from lerobot_bomb.sweep.manifest import Job, Manifest


def check(manifest: Manifest, begun: Sequence[Job] = ()) -> None:
    """Check that LeRobot reads every job's flags, and that no policy was trained for another environment.

    Jobs that differ from one in ``begun`` only in their conditions have been checked before.

    Raises:
        SystemExit: flags are wrong; LeRobot's parser has said which.
        ValueError: a policy's folder holds no checkpoint, or it was trained for another environment; the
            message names the flags to change.
    """
    logging.disable(logging.WARNING)  # the workers' log has them
    try:
        jobs = {_without_condition(job): job for job in manifest.jobs}
        for flags in jobs.keys() - set(map(_without_condition, begun)):
            job = jobs[flags]
            try:
                config = eval_config(job.flags)
            except FileNotFoundError as error:
                raise ValueError(
                    f"{job.policy[0]}: {error}; give the folder that lerobot-train names pretrained_model"
                ) from None
            with acting(config.policy):
                config.env.get_env_processors()
    finally:
        logging.disable(logging.NOTSET)


def _without_condition(job: Job) -> tuple[str, ...]:
    """Return the job's flags without perturbations: those are checked in the plan and bind no policy."""
    return (*job.policy, *(flag for flag in job.env if not flag.startswith("--env.perturbations=")))
