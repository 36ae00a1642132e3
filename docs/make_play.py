# pyright: reportAttributeAccessIssue=false, reportInvalidTypeForm=false
"""Build the page on which BOMB plays in a browser: the sources in docs/play/, MuJoCo's WASM, our episodes.

``make play`` runs it. JavaScript can neither draw an episode as NumPy does nor build the scene. So the page
gets from here all that Python decides: the model, constants, episodes under every axis. The page simulates,
acts, judges and draws.
"""

import argparse
import dataclasses
import gzip
import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from play_episodes import ROBOT, SuiteExport, actuator_noise, arrays_of, differences
from play_policy import export

from lerobot_bomb.bomb import board, commands, episode, expert, judge, move, observation
from lerobot_bomb.bomb.board import NUM_STONES
from lerobot_bomb.bomb.episode import TEST_SEEDS, EpisodeSpec, Failure, Stage
from lerobot_bomb.bomb.perturbations import AXES
from lerobot_bomb.bomb.suites import OWN_SUITES, place
from lerobot_bomb.conditions import MAX_LEVEL
from lerobot_env_bomb.bomb import hand, robots, scene
from lerobot_env_bomb.bomb import model as model_module
from lerobot_env_bomb.bomb.scene import EDITABLE, Scene
from lerobot_env_bomb.shared.mujoco_gl import mujoco

SOURCES = Path(__file__).parent / "play"
NODE_MODULES = Path(__file__).parents[1] / ".venv" / "npm" / "node_modules"
MUJOCO = NODE_MODULES / "@mujoco" / "mujoco"
ORT = NODE_MODULES / "onnxruntime-web" / "dist"
# {where npm has it: its name in the page}
PACKAGES = {
    MUJOCO / "mujoco.js": "mujoco.js",
    MUJOCO / "mujoco.wasm": "mujoco.wasm",
    ORT / "ort.wasm.bundle.min.mjs": "ort.js",
    ORT / "ort-wasm-simd-threaded.wasm": "ort.wasm",
}
PACKED = (".bin", ".json", ".onnx", ".wasm", ".xml")  # kinds of files that the page unpacks itself
# of those that come with the package, for all suites
POLICY = "fdvla_suites"
NUM_SEEDS = 20  # from the first of the protocol's seeds on

# whose numbers, names and tables the page uses
CONSTANTS: tuple[ModuleType, ...] = (
    *(board, commands, episode, expert, judge, move, observation),
    *(scene, model_module, place, robots, hand),
)


def is_plain(value: Any) -> bool:
    """Return True for what JSON can hold: numbers, texts, and lists of them."""
    if isinstance(value, tuple | list | np.ndarray):
        return all(map(is_plain, value))
    return isinstance(value, bool | int | float | str)


def constants() -> dict[str, dict[str, Any]]:
    """{module: {its constant: value}}, and what the page needs of classes."""
    modules = {
        each.__name__.rpartition(".")[2]: {
            name: list(value) if isinstance(value, np.ndarray) else value
            for name, value in vars(each).items()
            if name.isupper() and is_plain(value)
        }
        for each in CONSTANTS
    }
    modules["board"]["BOARD"] = dataclasses.asdict(board.BOARD) | {"half_size_m": board.BOARD.half_size_m}
    modules["model"]["STONE_RGBA"] = {
        "white": model_module.STONE_RGBA[True],
        "black": model_module.STONE_RGBA[False],
    }
    # MuJoCo's WASM gives no access to arrays of bool
    materials = model_module.compile_scene(robots.ROBOTS[ROBOT]).mat_texuniform
    modules["model"]["TEXTURE_IS_UNIFORM"] = [bool(each) for each in materials]
    arm = robots.ROBOTS[ROBOT]
    modules["robots"] |= {
        "MAX_HALF_OPENING_M": arm.max_half_opening_m,
        "JOINTS": list(arm.joints(np.array([*board.TRAY_CENTER_XY, 0.1]), 0.0)),
    }
    modules["episode"] |= {
        "STAGES": list(Stage),
        "FAILURES": {each.value: each.meaning for each in Failure},
        "SUCCESS_TOLERANCE_MM": EpisodeSpec(seed=0).success_tolerance_mm,
    }
    modules["scene"] |= {
        "PARKED": [model_module.parked_xyz(i).tolist() for i in range(NUM_STONES)],
        "EDITABLE": list(EDITABLE),
    }
    modules["perturbations"] = {"AXES": {name: axis_table(name) for name in AXES}, "MAX_LEVEL": MAX_LEVEL}
    return modules


def axis_table(name: str) -> dict[str, Any]:
    """Summary of an axis and its magnitudes."""
    axis = AXES[name]
    return {
        "summary": axis.summary,
        "magnitudes": [dataclasses.asdict(each) for each in axis.magnitudes.values()],
    }


def write_model(folder: Path) -> None:
    """Write the scene as XML, which any version of MuJoCo reads, with what XML rounds, and the textures."""
    xml = model_module.scene_spec(robots.ROBOTS[ROBOT])
    xml.compile()
    text = xml.to_xml()
    model, rounded_model = Scene(ROBOT).model, mujoco.MjModel.from_xml_string(text)
    names = [
        name
        for name in dir(model)
        if not name.startswith("_") and isinstance(getattr(model, name), np.ndarray) and name != "tex_data"
    ]
    exact = differences(arrays_of(rounded_model, names), arrays_of(model, names))
    (folder / "model.xml").write_text(text)
    write_json(folder / "exact.json", exact)
    (folder / "textures.bin").write_bytes(model.tex_data.tobytes())


def write_json(path: Path, value: Any) -> None:
    """Write a value on one line."""
    path.write_text(json.dumps(value, separators=(",", ":")))


def instructions_of(record: Mapping[str, Any]) -> set[str]:
    """Return all instructions of a suite's record, perturbed ones included."""
    episodes = [episode for of_task in record["episodes"] for episode in of_task]
    changes = [change for each in episodes for levels in each["axes"].values() for change in levels]
    return {text for each in [*episodes, *changes] for text in each.get("instructions", ())}


def pack(path: Path) -> None:
    """Replace a file by a gzipped one."""
    with gzip.GzipFile(f"{path}.gz", "wb", mtime=0) as packed:
        packed.write(path.read_bytes())
    path.unlink()


def build(folder: Path, seeds: Sequence[int], *, with_policy: bool = True) -> None:
    """Write the whole page; a policy's graph needs onnxscript, of the group `docs`."""
    missing = [str(path) for path in PACKAGES if not path.is_file()]
    if missing:
        raise SystemExit(f"There is no {', no '.join(missing)}; `make play` installs it with npm")
    folder.mkdir(parents=True, exist_ok=True)
    for source in SOURCES.iterdir():
        if source.suffix in (".js", ".css", ".html"):
            shutil.copy(source, folder)
    for path, name in PACKAGES.items():
        shutil.copy(path, folder / name)
    write_model(folder)
    exports = [f"export const {name} = {json.dumps(values)};\n" for name, values in constants().items()]
    exports.append(f"export const SEEDS = {json.dumps(list(seeds))};\n")
    exports.append(f"export const SUITES = {json.dumps(list(OWN_SUITES))};\n")
    exports.append(f"export const POLICY = {json.dumps(POLICY)};\n")
    (folder / "constants.js").write_text("".join(exports))
    write_json(folder / "noise.json", {str(seed): actuator_noise(seed) for seed in seeds})
    records = {suite: SuiteExport(suite, seeds).record() for suite in OWN_SUITES}
    for suite, record in records.items():
        write_json(folder / f"{suite}.json", record)
    if with_policy:
        export(POLICY, set().union(*map(instructions_of, records.values())), folder)
    for path in [path for path in folder.iterdir() if path.suffix in PACKED]:
        pack(path)
    size = sum(path.stat().st_size for path in folder.iterdir())
    print(f"Built: {folder / 'index.html'}, {size / 1e6:.1f} MB")


def main() -> None:
    """Build the page that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="where the page is written")
    parser.add_argument("--seeds", type=int, default=NUM_SEEDS, help="number of seeds of each task")
    args = parser.parse_args()
    build(args.folder, TEST_SEEDS[: args.seeds])


if __name__ == "__main__":
    main()
