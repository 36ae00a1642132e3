"""BOMB as a benchmark of allenai's vla-evaluation-harness, and LeRobot's checkpoints as its model servers."""

from importlib.util import find_spec

if find_spec("vla_eval") is None:  # an extra, which few need
    raise ModuleNotFoundError(
        f"{__name__} needs vla-eval: pip install 'lerobot_policy_bomb[vla-eval]'", name=__name__
    )
