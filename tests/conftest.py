"""Fixtures that several test modules use."""

import os
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ["HF_HUB_OFFLINE"] = "1"  # no test may need the network


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real tokenizers and demonstrations; a clone alone does not have them."""
    path = Path(os.environ.get("SHARED_DATA", Path(__file__).parents[1] / ".." / "shared" / "data"))
    if not path.is_dir():
        pytest.skip(f"{path} is absent; set SHARED_DATA to the folder of real inputs")
    return path.resolve()


@pytest.fixture
def stock_cli(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Run a stock LeRobot command in this process: stock_cli("lerobot-eval", "--env.type=bomb", ...)."""

    def run(command: str, *flags: str) -> None:
        from lerobot.scripts import lerobot_eval, lerobot_train

        mains = {"lerobot-eval": lerobot_eval.main, "lerobot-train": lerobot_train.main}
        monkeypatch.setattr(sys, "argv", [command, *flags])
        mains[command]()

    return run
