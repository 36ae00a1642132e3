"""Refusals of `lerobot-bomb convert libero-hdf5`, before it writes anything, and how it words them."""

import importlib.util
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from libero_cases import REPO_ID, TASK, Demonstration, write_file

from lerobot_bomb.commands import main as cli

pytest.importorskip("h5py")


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    demonstrations = [Demonstration.drawn(seed) for seed in range(2)]
    return write_file(tmp_path_factory.mktemp("source") / f"{TASK}_demo.hdf5", demonstrations)


def change(edit: Callable[[Any], object]) -> Callable[[Path], None]:
    """Change the group `data` of a file."""

    def change_file(path: Path) -> None:
        import h5py

        with h5py.File(path, "r+") as file:
            edit(file["data"])

    return change_file


def put(name: str, index: Any, value: float) -> Callable[[Path], None]:
    def edit(data: Any) -> None:
        data[name][index] = value

    return change(edit)


def replace(name: str, edit: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    def edit_data(data: Any) -> None:
        values = data[name][()]
        del data[name]
        data[name] = edit(values)

    return change(edit_data)


def delete(name: str) -> Callable[[Path], None]:
    return change(lambda data: data.__delitem__(name))


def never_written(data: Any) -> None:
    shape = data["demo_1/obs/agentview_rgb"].shape
    del data["demo_1/obs/agentview_rgb"]
    data.create_dataset("demo_1/obs/agentview_rgb", shape, np.uint8)


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-5000])


def open_at_plus_one(data: Any) -> None:
    for demo in data.values():
        demo["actions"][:, 6] = -demo["actions"][:, 6]


def other_states(data: Any) -> None:
    for demo in data.values():
        demo["states"][:, 1:8] += 3


BROKEN: dict[str, tuple[Callable[[Path], object], str]] = {
    "no HDF5": (lambda p: p.write_text("x"), "_demo.hdf5 cannot be read as HDF5, or is cut off"),
    "cut off": (truncate, "_demo.hdf5 cannot be read as HDF5, or is cut off"),
    "no demonstrations": (change(lambda data: data.clear()), "data holds no demo_0, demo_1, ..."),
    "no images": (
        delete("demo_0/obs"),
        "LIBERO's scripts/create_dataset.py plays such a recording and writes",
    ),
    "one camera": (delete("demo_1/obs/eye_in_hand_rgb"), "data/demo_1 has no obs/eye_in_hand_rgb"),
    "no states": (delete("demo_1/states"), "data/demo_1 has no states"),
    "other images": (
        replace("demo_1/obs/eye_in_hand_rgb", lambda v: v[:, ::2]),
        "demo_1/obs/eye_in_hand_rgb is (6, 32, 64, 3) of uint8; it must be (6, 64, 64, 3) of uint8",
    ),
    "images of floats": (
        replace("demo_0/obs/agentview_rgb", lambda v: v / 255),
        "demo_0/obs/agentview_rgb is (6, 64, 64, 3) of float64",
    ),
    "images that were never written": (change(never_written), "demo_1/obs/agentview_rgb was never written"),
    "fewer states": (
        replace("demo_0/obs/ee_pos", lambda v: v[1:]),
        "obs/ee_pos has the shape (5, 3); it must be",
    ),
    "quaternions": (
        replace("demo_0/obs/ee_ori", lambda v: v[:, [0, 0, 1, 2]]),
        "demo_0/obs/ee_ori has the shape (6, 4); it must be (6, 3)",
    ),
    "one action": (
        replace("demo_0/actions", lambda v: v[:1]),
        "data/demo_0 has 1 actions; at least 2 are needed",
    ),
    "nan": (put("demo_1/actions", (2, 3), np.nan), "demo_1/actions holds NaN or infinite values"),
    "absolute actions": (
        put("demo_1/actions", (2, 2), 1.5),
        "demo_1/actions holds 1.5; LIBERO's are in -1..1",
    ),
    "gripper in 0..1": (
        replace("demo_0/actions", lambda v: np.where(np.arange(7) == 6, (v + 1) / 2, v)),
        "the gripper is never told to open (-1)",
    ),
    "gripper opens at +1": (change(open_at_plus_one), "LIBERO's close at +1 and open at -1"),
    "states of others": (change(other_states), "are those of no row of states, 2.99 rad off"),
    "another convention": (
        change(lambda data: data.attrs.update(macros_image_convention="vulkan")),
        "macros_image_convention is 'vulkan'; give --image_convention, one of opengl, opencv, lerobot",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_source_is_one_clear_error_and_nothing_is_written(
    case: str, source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    edit, expected = BROKEN[case]
    path = tmp_path / source.name
    shutil.copy(source, path)
    edit(path)
    assert expected in refusal(path, tmp_path, capsys)
    assert list(tmp_path.iterdir()) == [path]


def refusal(path: Path, folder: Path, capsys: pytest.CaptureFixture[str], *flags: str) -> str:
    root = folder / "new" / "x"
    assert (
        cli.main(["convert", "libero-hdf5", str(path), f"--repo_id={REPO_ID}", f"--root={root}", *flags]) == 1
    )
    *_, error = capsys.readouterr().err.splitlines()
    assert error.startswith("lerobot-bomb convert libero-hdf5: ")
    return error


def test_paths_without_demonstrations_are_named(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert f"{tmp_path / 'no'} does not exist; name a file" in refusal(tmp_path / "no", tmp_path, capsys)
    assert "holds no file TASK_demo.hdf5" in refusal(tmp_path, tmp_path, capsys)
    (tmp_path / "libero_10").mkdir()
    shutil.copy(source, tmp_path / "libero_10")
    assert "; name one of its folders: libero_10" in refusal(tmp_path, tmp_path, capsys)


def test_an_unknown_convention_is_refused(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    error = refusal(source, tmp_path, capsys, "--image_convention=vulkan")
    assert "--image_convention='vulkan' is unknown; choose one of: opengl, opencv, lerobot" in error


def test_a_demonstration_of_noops_is_refused_with_skip_noops(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / source.name
    shutil.copy(source, path)
    replace("demo_1/actions", lambda actions: np.full(actions.shape, [0, 0, 0, 0, 0, 0, -1.0]))(path)
    error = refusal(path, tmp_path, capsys, "--skip_noops")
    assert f"{path}: data/demo_1 would have no frame left; leave --skip_noops out" in error


def test_an_existing_folder_is_refused(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "new" / "x").mkdir(parents=True)
    assert "exists already" in refusal(source, tmp_path, capsys)


@pytest.mark.parametrize(
    ("name", "env"),
    [("lift/demo", "Lift"), ("wipe/panda/demo", "Wipe"), ("handover/panda_panda/demo", "TwoArmHandover")],
)
def test_demonstrations_of_robosuite_are_refused_with_the_way_out(
    name: str, env: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The files that its wheel ships hold states and actions, no image."""
    spec = importlib.util.find_spec("robosuite")
    if spec is None or spec.origin is None:
        pytest.skip("robosuite is not installed")
    path = Path(spec.origin).parent / "models" / "assets" / "demonstrations" / f"{name}.hdf5"
    error = refusal(path, tmp_path, capsys)
    assert f"{path} holds no images (obs/agentview_rgb, obs/eye_in_hand_rgb)" in error
    assert f"robosuite's environment {env}, which LeRobot does not have" in error
    assert "hf download yifengzhu-hf/LIBERO-datasets --repo-type=dataset --local-dir=LIBERO" in error


def test_a_missing_h5py_is_named(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "h5py", None)
    assert "run pip install h5py" in refusal(source, tmp_path, capsys)
