"""`lerobot-bomb view gallery`: the sheets show the environment, the page says what the table says."""

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lerobot_bomb.bomb.board import BOARD
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.observation import RenderOptions
from lerobot_bomb.bomb.perturbations import AXES
from lerobot_bomb.bomb.suite import find_suite, specs_of_tasks
from lerobot_bomb.commands import main as cli
from lerobot_bomb.commands.view_gallery import COLUMNS, axis_sheet, suite_sheet
from lerobot_bomb.conditions import ALL, Axis
from lerobot_bomb.environments import BOMB, BOMB_PUSHT
from lerobot_bomb.envs.rollout import make_env
from lerobot_bomb.libero.perturbations import LIBERO_AXES
from lerobot_bomb.pusht.episode import PushTSpec
from lerobot_bomb.pusht.perturbations import PUSHT_AXES
from lerobot_bomb.viewing.bomb import PATH_RGB, path_tile
from lerobot_bomb.viewing.perturbations_page import example_instructions, page
from lerobot_bomb.viewing.pusht import make_pusht_env
from lerobot_bomb.viewing.sheet import PAPER, Sheet, text_tile

SIZE = 48
OPTIONS = RenderOptions(image_size=SIZE)
DOCS = Path(__file__).parents[1] / "docs"


def tile(sheet: Sheet, drawn: np.ndarray, row: int, column: int) -> np.ndarray:
    y, x = sheet.tile_origin(row, column)
    return drawn[y : y + SIZE, x : x + SIZE]


def start(axis: str, level: int, seed: int) -> tuple[dict[str, np.ndarray], str]:
    """Return both cameras' images at the start of an episode, and its instruction."""
    env = make_env(EpisodeSpec(seed, perturbations=f"{axis}:{level}"), OPTIONS)
    observation, _ = env.reset(seed=seed)
    instruction = env.get_wrapper_attr("task_description")
    env.close()
    return observation["pixels"], instruction


def test_tiles_are_the_environments_own_images() -> None:
    sheet = axis_sheet(BOMB, "camera", (3, 9), SIZE)
    drawn = sheet.draw()
    assert list(sheet.images) == [
        f"{camera}, seed {seed}" for seed in (3, 9) for camera in ("workspace", "wrist")
    ]
    for column in range(6):
        for i, seed in enumerate((3, 9)):
            images, _ = start("camera", column, seed)
            assert np.array_equal(tile(sheet, drawn, 2 * i, column), images["workspace"])
            assert np.array_equal(tile(sheet, drawn, 2 * i + 1, column), images["wrist"])
    assert not np.array_equal(tile(sheet, drawn, 0, 0), tile(sheet, drawn, 2, 0))


def test_a_sheet_leaves_paper_between_and_around_its_tiles() -> None:
    black = np.zeros((SIZE, SIZE, 3), np.uint8)
    sheet = Sheet("x", ["a", "b", "c"], {"size": ["1", "2", "3"]}, {"one": [black] * 3, "two": [black] * 3})
    drawn = sheet.draw()
    covered = np.zeros(drawn.shape[:2], bool)
    for row in range(2):
        for column in range(3):
            y, x = sheet.tile_origin(row, column)
            assert not covered[y : y + SIZE, x : x + SIZE].any()
            covered[y : y + SIZE, x : x + SIZE] = True
    y, x = sheet.tile_origin(0, 0)
    assert sheet.tile_origin(1, 1) > (y + SIZE, x + SIZE)
    assert sheet.tile_origin(0, 1)[1] > x + SIZE
    assert (drawn[covered] == 0).all()
    assert (drawn[y:, x:][~covered[y:, x:]] == PAPER).all()
    assert (drawn[:y] != PAPER).any(), "the captions"


def test_captions_are_the_table() -> None:
    sheet = axis_sheet(BOMB, "dynamics", (3,), SIZE)
    assert sheet.columns == COLUMNS == ["nominal", "level 1", "level 2", "level 3", "level 4", "level 5"]
    assert sheet.texts["mass, factor"] == ["", "1.15", "1.3", "1.5", "1.75", "2"]
    assert sheet.texts["latency, control steps"] == ["", "0", "0", "0", "1", "1"]
    assert sheet.title.startswith("dynamics: mass and friction of the stones")
    assert sheet.title.endswith("the images stay as they are")
    ((label, paths),) = sheet.images.items()
    assert label == "expert's path, seed 3"
    assert all((path == PATH_RGB).all(axis=2).sum() > SIZE / 2 for path in paths), "the whole way"
    assert not np.array_equal(paths[5], paths[0])


def test_language_shows_instructions() -> None:
    sheet = axis_sheet(BOMB, "language", (3,), SIZE)
    assert list(sheet.images) == ["instruction, seed 3"]
    for level, shown in enumerate(sheet.images["instruction, seed 3"]):
        _, instruction = start("language", level, 3)
        assert np.array_equal(shown, text_tile(instruction, SIZE))
    assert not np.array_equal(text_tile("row 1", SIZE), text_tile("row 2", SIZE))


def test_a_instruction_is_broken_into_lines_that_fit() -> None:
    text = "Place a black stone on the board at row 1, please."
    inked = (text_tile(text, 200) != text_tile("", 200)).any(axis=2)
    assert inked[:18].any()
    assert inked[18:40].any()
    assert not inked[:, -4:].any()


def test_a_long_instruction_is_written_smaller() -> None:
    text = "Pick up the stone and put it on the board, " * 5
    inked = (text_tile(text + "please.", 128) != text_tile(text, 128)).any(axis=2)
    assert inked.any(), "its last word is there"
    assert not inked[-2:].any()


def test_all_shows_everything_that_changes() -> None:
    sheet = axis_sheet(BOMB, ALL, (3,), SIZE)
    rows = ["workspace", "wrist", "instruction", "expert's path"]
    assert list(sheet.images) == [f"{row}, seed 3" for row in rows]
    assert sheet.title == "all: every axis but goal_marker"


def test_a_path_is_drawn_where_it_went() -> None:
    cell = BOARD.intersection_xy(1, 2)
    start_xy = np.array([0.17, 0.0])
    drawn = path_tile(np.stack([start_xy, cell]), np.stack([start_xy, start_xy]), 340)
    inked = np.argwhere((drawn == PATH_RGB).all(axis=2))
    # 1 mm per pixel, and the workspace's middle, x = 40 mm, in the tile's
    ends_xy = inked[[inked[:, 1].argmin(), inked[:, 1].argmax()]][:, ::-1] / 1000 * [1, -1] + [-0.13, 0.17]
    np.testing.assert_allclose(ends_xy, [cell, start_xy], atol=0.0021)


def test_the_command_writes_small_sheets_and_replaces_its_own(tmp_path: Path) -> None:
    folder = tmp_path / "sheets"
    flags = ["view", "gallery", "--axes=[light,language]", "--seeds=[3]", f"--image_size={SIZE}"]
    assert cli.main([*flags, f"--output={folder}"]) == 0
    (folder / "light.jpg").write_bytes(b"an older one")
    assert cli.main([*flags, f"--output={folder}"]) == 0
    assert sorted(path.name for path in folder.iterdir()) == ["language.jpg", "light.jpg"]
    expected = axis_sheet(BOMB, "light", (3,), SIZE).draw()
    shown = np.asarray(Image.open(folder / "light.jpg"))
    assert shown.shape == expected.shape
    assert np.abs(shown.astype(int) - expected).mean() < 4


@pytest.mark.parametrize(
    ("flag", "message"),
    [
        ("--axes=camra", "--axes='camra' is unknown; choose one of: table, reflectance"),
        ("--image_size=8", "--env.image_size=8 must lie in 32..1024"),
        ("--seeds=99999999999", "--seeds: 99999999999 must lie in 0.."),
    ],
)
def test_a_bad_flag_is_named_and_nothing_is_written(
    flag: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["view", "gallery", flag, f"--output={tmp_path / 'x'}"]) == 1
    assert capsys.readouterr().err.startswith(f"lerobot-bomb view gallery: {message}")
    assert list(tmp_path.iterdir()) == []


def test_the_committed_page_is_the_generated_one() -> None:
    assert (DOCS / "perturbations.md").read_text() == page(example_instructions(), "media/perturbations")


def test_the_page_has_every_axis_with_its_sheet() -> None:
    text = (DOCS / "perturbations.md").read_text()
    assert re.findall(r"^## (\w+)$", text, re.MULTILINE) == [*AXES, ALL]
    links = re.findall(r"\]\((.*?\.jpg)\)", text)
    assert links == [f"media/perturbations/{name}.jpg" for name in (*AXES, ALL)]
    for link in links:
        assert 10_000 < (DOCS / link).stat().st_size < 300_000
        assert Image.open(DOCS / link).width > 500


def test_a_sheet_of_pusht_shows_its_environment(tmp_path: Path) -> None:
    pytest.importorskip("gym_pusht", reason="gym-pusht is not installed: pip install '.[pusht]'")
    sheet = axis_sheet(BOMB_PUSHT, "goal", (3,), SIZE)
    assert list(sheet.images) == ["start, seed 3", "instruction, seed 3"]
    assert sheet.texts["turn, degrees"] == ["", "12", "24", "36", "48", "60"]
    for level, image in enumerate(sheet.images["start, seed 3"]):
        spec = PushTSpec(3, perturbations=f"goal:{level}")
        env = make_pusht_env(spec, SIZE)
        assert np.array_equal(env.reset(seed=3)[0]["pixels"], image)
    flags = ["view", "gallery", "--env.type=bomb_pusht", f"--image_size={SIZE}", f"--output={tmp_path}"]
    assert cli.main([*flags, "--axes=dynamics"]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["dynamics.jpg"]


def test_a_suites_sheet_shows_every_task_and_what_the_expert_leaves() -> None:
    sheet = suite_sheet("object", (3,), OPTIONS)
    assert list(sheet.images) == [f"task {number}" for number in range(find_suite("object").num_tasks)]
    for number, (instruction, before, after) in enumerate(sheet.images.values()):
        (spec,) = specs_of_tasks(EpisodeSpec(3, "object"), [number])
        env = make_env(spec, OPTIONS)
        observation, _ = env.reset(seed=3)
        assert np.array_equal(before, observation["pixels"]["workspace"])
        assert np.array_equal(instruction, text_tile(env.get_wrapper_attr("task_description"), SIZE))
        assert not np.array_equal(before, after)
        env.close()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--axes=camera"], "--axes='camera' is unknown; choose one of: table, start"),
        (["--doc=page.md"], "--doc=page.md is written for --env.type=bomb only"),
        (["--env.type=libero"], "--env.type='libero' is unknown; choose one of: bomb, bomb_pusht"),
    ],
)
def test_a_flag_that_pusht_does_not_have_is_named(
    flags: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["view", "gallery", "--env.type=bomb_pusht", *flags, f"--output={tmp_path / 'x'}"]) == 1
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(("name", "axes"), [("pusht", PUSHT_AXES), ("libero", LIBERO_AXES)])
def test_every_axis_of_an_environment_has_its_sheet(name: str, axes: Mapping[str, Axis]) -> None:
    text = (DOCS / "reference" / "axes.md").read_text()
    for axis in axes:
        sheet = f"media/bomb_{name}/{axis}.jpg"
        assert f"(../{sheet})" in text
        assert 10_000 < (DOCS / sheet).stat().st_size < 300_000
