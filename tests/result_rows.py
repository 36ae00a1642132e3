"""Rows of results files on BOMB, and what is read and printed of them."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from lerobot_bomb.bomb.board import task_id
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.perturbations import Condition
from lerobot_bomb.commands.main import main
from lerobot_bomb.results.bomb import OLD_VERSION, EpisodeResult
from lerobot_bomb.results.origin import PolicyIdentity
from lerobot_bomb.results.reading import parse_record

ACT = PolicyIdentity("act", "outputs/act", None, "a" * 64, "b" * 64)
FDVLA = PolicyIdentity("fdvla", "me/fdvla", "0123456789ab", "c" * 64, "d" * 64)


def values(seed: int, failure: str | None = None, error: float | None = None, **other: Any) -> dict[str, Any]:
    """The fields of a line; those of the spec are given as `spec`."""
    spec = {"seed": seed} | other.pop("spec", {})
    episode = EpisodeSpec(**spec)
    target = spec.get("target") or other.get("target", (2, 2))
    color = spec.get("color") or other.get("color", "black")
    condition = Condition(episode.perturbations)
    is_placed = failure in (None, "disturbed_others")
    is_elsewhere = failure == "wrong_intersection" and target is not None
    result = EpisodeResult(
        task_version="1.0",
        spec=episode,
        instruction="Put it there.",
        task_id=task_id(target, color) if target and episode.suite == "place" else episode.task_id or 0,
        target=target,
        color=color,
        steps=20,
        progress=float(is_placed),
        is_success=failure is None,
        is_success_bomb_v0=failure is None and target is not None,
        failure=failure,
        stage="placed" if is_placed else "start" if failure == "never_reached" else "lifted",
        placement_error_mm=(40.0 if is_elsewhere else 1.0) if error is None else error,
        nearest_intersection=(target[0], (target[1] + 1) % 5)
        if target and is_elsewhere
        else target or (2, 2),
        collateral_mm=20.0 if failure == "disturbed_others" else 0.0,
        levels={axis: high for axis, _, high in condition.ranges},
        opengl_vendor="Mesa",
        opengl_renderer="llvmpipe",
        mujoco_version="3.8.1",
    )
    policy = other.pop("policy", ACT)
    return asdict(result) | {"policy": policy and asdict(policy)} | other


def row(seed: int, failure: str | None = None, error: float | None = None, **other: Any) -> str:
    return json.dumps(values(seed, failure, error, **other)) + "\n"


def read(values: dict[str, Any]) -> EpisodeResult:
    """Return the record of these fields."""
    record = parse_record(json.dumps(values).encode())
    assert isinstance(record, EpisodeResult)
    return record


def old_row(seed: int, **other: Any) -> str:
    """Write a row as protocol 1.0 did."""
    new = values(seed, **other)
    return json.dumps(
        {name: new[name] for name in new if name not in EpisodeResult.versions[OLD_VERSION]}
        | {"protocol_version": "1.0"}
    )


def printed(path: Path, text: str, capsys: pytest.CaptureFixture[str]) -> str:
    """Return what `lerobot-bomb results --verbose` says of a file."""
    path.write_text(text)
    assert main(["results", str(path), "--verbose"]) == 0
    return capsys.readouterr().out
