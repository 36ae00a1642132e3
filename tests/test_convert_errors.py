"""Refusals of `lerobot-bomb convert pusht-zarr`, before it writes anything, and how it words them."""

import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pusht_cases import REPO_ID, Demonstrations, write_zarr

from lerobot_bomb.commands import main as cli
from lerobot_bomb.data.pusht_conversion import convert_pusht
from lerobot_bomb.data.unfinished import lock_folder


def overwrite(path: Path, name: str, change: Callable[[np.ndarray], np.ndarray]) -> None:
    """Change one array of a zarr."""
    import zarr

    group = zarr.open_group(path, mode="r")
    values = np.array(group[name])
    shutil.rmtree(path / name)
    write_zarr(path.with_name("other"), {name: change(values)})
    shutil.move(path.with_name("other") / name, path / name)
    shutil.rmtree(path.with_name("other"))


def put(index: tuple[int, ...], value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(values: np.ndarray) -> np.ndarray:
        values[index] = value
        return values

    return change


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1])


BROKEN: dict[str, tuple[Callable[[Path], object], str]] = {
    "no group": (lambda p: (p / ".zgroup").unlink(), "is no zarr: it must be a folder that holds .zgroup"),
    "format 3": (
        lambda p: (p / "zarr.json").write_text("{}"),
        "zarr of format 3; PushT is published in format 2",
    ),
    "no images": (lambda p: shutil.rmtree(p / "data" / "img"), "holds no array data/img, so it is not PushT"),
    "no ends": (lambda p: shutil.rmtree(p / "meta"), "holds no array meta/episode_ends, so it is not PushT"),
    "metadata": (lambda p: (p / "data/img/.zarray").write_text("{"), "data/img/.zarray cannot be read"),
    "flat images": (
        lambda p: overwrite(p, "data/img", lambda v: v[..., :1]),
        r"img has the shape (420, 96, 96, 1)",
    ),
    "three actions": (lambda p: overwrite(p, "data/action", lambda v: v[:, [0, 1, 1]]), "has (420, 2)"),
    "short states": (lambda p: overwrite(p, "data/state", lambda v: v[:-1]), "state has the shape (419, 5)"),
    "half a grey": (
        lambda p: overwrite(p, "data/img", put((9, 3, 4, 1), 100.5)),
        "img/0.0.0.0 holds 100.5, but",
    ),
    "bright": (lambda p: overwrite(p, "data/img", put((200, 3, 4, 1), 256)), "img/1.0.0.0 holds 256.0, but"),
    "nan pixel": (lambda p: overwrite(p, "data/img", put((0, 0, 0, 0), np.nan)), "0..255"),
    "far target": (
        lambda p: overwrite(p, "data/action", put((400, 1), 512.5)),
        "action/2.0 holds 512.5, but",
    ),
    "nan action": (lambda p: overwrite(p, "data/action", put((0, 0), np.nan)), "numbers in 0..512"),
    "agent outside": (lambda p: overwrite(p, "data/state", put((3, 0), -1)), "first two lie in 0..512"),
    "endless angle": (lambda p: overwrite(p, "data/state", put((3, 4), np.inf)), "state/0.0 holds inf"),
    "ends fall": (lambda p: overwrite(p, "meta/episode_ends", put((1,), 100)), "must increase"),
    "empty episode": (lambda p: overwrite(p, "meta/episode_ends", put((1,), 161)), "must increase"),
    "ends early": (lambda p: overwrite(p, "meta/episode_ends", put((2,), 419)), "ends at frame 419"),
    "float ends": (lambda p: overwrite(p, "meta/episode_ends", lambda v: v + 0.5), "must be whole numbers"),
    "no episode": (lambda p: overwrite(p, "meta/episode_ends", lambda v: v[:0]), "must be whole numbers"),
    "lost chunk": (lambda p: (p / "data/img/1.0.0.0").unlink(), "img/1.0.0.0 is missing"),
    "lost action": (lambda p: (p / "data/action/2.0").unlink(), "action/2.0 is missing"),
    "lost ends": (lambda p: (p / "meta/episode_ends/0").unlink(), "episode_ends/0 is missing"),
    "cut chunk": (lambda p: truncate(p / "data/img/1.0.0.0"), "img/1.0.0.0 cannot be decoded"),
    "cut state": (lambda p: truncate(p / "data/state/0.0"), "state/0.0 cannot be decoded"),
    "empty chunk": (lambda p: (p / "data/img/2.0.0.0").write_bytes(b""), "img/2.0.0.0 cannot be decoded"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_source_is_one_clear_error_and_nothing_is_written(
    case: str, pusht_zarr: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    change, expected = BROKEN[case]
    path = tmp_path / "broken.zarr"
    shutil.copytree(pusht_zarr, path)
    change(path)
    command = ["convert", "pusht-zarr", str(path), f"--repo_id={REPO_ID}", f"--root={tmp_path / 'new' / 'x'}"]
    assert cli.main(command) == 1
    *_, error = capsys.readouterr().err.splitlines()
    assert error.startswith("lerobot-bomb convert pusht-zarr: ") and expected in error
    assert list(tmp_path.iterdir()) == [path]


def test_a_path_that_is_no_zarr_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for name in ("nothing", "file", "."):
        with pytest.raises(ValueError, match="is no zarr"):
            convert_pusht(tmp_path / name, REPO_ID, tmp_path / "x")


def test_an_existing_folder_is_refused(pusht_zarr: Path, pusht_dataset: Path) -> None:
    with pytest.raises(ValueError, match=f"--root={pusht_dataset} exists already"):
        convert_pusht(pusht_zarr, REPO_ID, pusht_dataset)


def test_resume_refuses_another_source_and_another_flag(
    pusht_zarr: Path, pusht_dataset: Path, pusht_demonstrations: Demonstrations, tmp_path: Path
) -> None:
    other = replace(pusht_demonstrations, actions=pusht_demonstrations.actions[::-1])
    other.write(tmp_path / "other.zarr")
    with pytest.raises(
        ValueError, match=r"--resume: the conversion in .* differs in source='pusht-zarr \w{64}' "
    ):
        convert_pusht(tmp_path / "other.zarr", REPO_ID, pusht_dataset, resume=True)
    with pytest.raises(ValueError, match=r"differs in task='Push.' \(it has ''\)"):
        convert_pusht(pusht_zarr, REPO_ID, pusht_dataset, task="Push.", resume=True)
    with pytest.raises(ValueError, match="there is no conversion to resume"):
        convert_pusht(pusht_zarr, REPO_ID, tmp_path / "x", resume=True)


def test_two_conversions_into_one_folder_are_refused(pusht_zarr: Path, tmp_path: Path) -> None:
    with (
        lock_folder(tmp_path / "x.conversion"),
        pytest.raises(ValueError, match="another process is at work"),
    ):
        convert_pusht(pusht_zarr, REPO_ID, tmp_path / "x")


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        (["libero-hdf5", "x"], "--repo_id"),
        (["pusht-zarr", "x"], "--repo_id"),
        (["pusht-zarr", "--repo_id=a/b"], "path"),
    ],
)
def test_missing_and_unknown_arguments_are_named(
    flags: list[str], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        cli.main(["convert", *flags])
    assert expected in capsys.readouterr().err.splitlines()[-1]


def test_an_unknown_source_is_answered_with_those_that_there_are(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["convert", "aloha-hdf5", "x"]) == 2
    assert "there are pusht-zarr, libero-hdf5" in capsys.readouterr().err


def test_a_bad_repo_id_is_named(pusht_zarr: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["convert", "pusht-zarr", str(pusht_zarr), "--repo_id=nobody"]) == 1
    assert "--repo_id='nobody' must have the form USER/NAME" in capsys.readouterr().err


def test_a_missing_zarr_package_is_named(
    pusht_zarr: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "zarr", None)
    flags = [f"--repo_id={REPO_ID}", f"--root={tmp_path / 'x'}"]
    assert cli.main(["convert", "pusht-zarr", str(pusht_zarr), *flags]) == 1
    (error,) = capsys.readouterr().err.splitlines()
    assert "pip install zarr" in error
    assert list(tmp_path.iterdir()) == []
