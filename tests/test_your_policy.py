"""The policy type that docs/your_policy.md shows works."""

import os
import re
from pathlib import Path

import pytest

from lerobot_bomb.commands.main import main
from lerobot_bomb.results.groups import read_results

PAGE = Path(__file__).parents[1] / "docs" / "your_policy.md"


@pytest.mark.long
def test_a_type_of_ones_own_is_swept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    (tmp_path / "lerobot_policy_mine").mkdir()
    (tmp_path / "lerobot_policy_mine" / "__init__.py").write_text(code)
    paths = [str(tmp_path), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, paths)))
    flags = ["--policies=mine", "--env.type=bomb", "--env.image_size=32", "--policy.device=cpu"]
    flags += ["--env.discover_packages_path=lerobot_policy_mine", "--episodes=1", "--batch_size=1"]
    assert main(["sweep", str(tmp_path / "sweep"), *flags]) == 0
    (record,) = read_results(tmp_path / "sweep" / "results.jsonl")
    assert record.policy is not None and record.policy.type == "mine"
