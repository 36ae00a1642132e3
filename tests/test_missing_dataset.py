"""A training on a dataset that is not there ends in one line that says what may be meant."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

FLAGS = (
    "--policy.type=vla0_smol",
    "--policy.vlm_model_name=nano",
    "--policy.device=cpu",
    "--dataset.repo_id=me/stones",
)


def test_a_misspelt_root_is_named(stock_cli: Callable[..., None], tmp_path: Path) -> None:
    root = tmp_path / "stnoes"
    message = rf"{root} holds no dataset \(meta/info.json\), and me/stones cannot be had .* misspelt\?$"
    with pytest.raises(FileNotFoundError, match=message):
        stock_cli("lerobot-train", *FLAGS, f"--dataset.root={root}", f"--output_dir={tmp_path / 'train'}")


@pytest.mark.parametrize(("kind", "command"), [("recording", "record"), ("conversion", "convert")])
def test_an_unfinished_one_is_to_be_finished(
    kind: str, command: str, stock_cli: Callable[..., None], tmp_path: Path
) -> None:
    root, growing = tmp_path / "stones", tmp_path / f"stones.{kind}"
    growing.mkdir()
    (growing / f"{kind}.json").write_text(json.dumps({}))
    with pytest.raises(
        FileNotFoundError, match=rf"{root} is not finished .*`lerobot-bomb {command} .*--resume"
    ):
        stock_cli("lerobot-train", *FLAGS, f"--dataset.root={root}", f"--output_dir={tmp_path / 'train'}")
