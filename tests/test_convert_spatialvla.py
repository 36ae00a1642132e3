"""Published SpatialVLA folders as checkpoints: one that the authors' classes wrote, and small ones alike."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from published_spatialvla import (
    ACTION,
    ASSUMED,
    CAMERA,
    DATA_SET,
    TASK,
    cells_of,
    convert,
    converted,
    gaussians,
    load,
    make_original,
    observations,
    published_config,
    published_tensors,
    write_published,
)
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from lerobot_bomb.actions.grid_settings import ActionGroup
from lerobot_bomb.vlm.tokenizer import nano_tokenizer
from lerobot_policy_bomb.spatialvla_grid.modeling_spatialvla_grid import SpatialvlaGridPolicy


@pytest.fixture(scope="module")
def original() -> SpatialvlaGridPolicy:
    return make_original(0)


@pytest.fixture(scope="module")
def folder(original: SpatialvlaGridPolicy, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_published(original, tmp_path_factory.mktemp("published") / "tiny")


@pytest.fixture(scope="module")
def authors(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A folder that the authors' own classes wrote, and a checkpoint of it."""
    folder = shared_data / "spatialvla" / "tiny_original"
    if not folder.is_dir():
        pytest.skip(f"{folder} is absent; set SHARED_DATA to the folder of real inputs")
    return folder, converted(folder, tmp_path_factory.mktemp("converted") / "checkpoint")


# The authors' own


@pytest.mark.parametrize(
    ("flags", "expected"), [({}, "cells_with_zoedepth"), ({"depth_source": "none"}, "cells_without_depth")]
)
def test_a_converted_checkpoint_chooses_the_cells_of_the_authors_classes(
    flags: dict[str, str], expected: str, authors: tuple[Path, Path]
) -> None:
    folder, checkpoint = authors
    policy, preprocessor, _ = load(checkpoint, **flags)
    with np.load(folder / "expected.npz") as arrays:
        images = torch.from_numpy(arrays["images"]).permute(0, 3, 1, 2) / 255
        batch = preprocessor({CAMERA: images, "task": [TASK] * len(images)})
        np.testing.assert_array_equal(policy.prompt(batch).ids, arrays["prompt_ids"])
        np.testing.assert_array_equal(cells_of(policy, batch), arrays[expected])
        if not flags:
            logits = first_logits(policy, batch)
            np.testing.assert_allclose(logits, arrays["first_logits_with_zoedepth"], rtol=0, atol=2e-5)


def first_logits(policy: SpatialvlaGridPolicy, batch: dict[str, Any]) -> torch.Tensor:
    """Return the logits of the first step's translation: (B, cells)."""
    answer = torch.zeros(len(batch[CAMERA]), 4 * 3, dtype=torch.long)
    return policy._logits(policy._group_rows[0], policy._hidden(batch, answer)[0][:, 0]).detach()


QUESTION = "What action should the robot take to {}?"


def test_the_slides_question_is_a_flag_that_the_checkpoint_keeps(
    authors: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Logits tell another prompt, which cells need not."""
    folder, bare = authors
    asked = converted(folder, tmp_path / "asked", task_template=QUESTION)
    assert f"prompt: {QUESTION!r} around the instruction, as --task_template asks" in capsys.readouterr().out
    with np.load(folder / "expected.npz") as arrays:
        images = torch.from_numpy(arrays["images"]).permute(0, 3, 1, 2) / 255
        expected, ids = arrays["first_logits_with_zoedepth"], arrays["prompt_ids"]
    raw = {CAMERA: images, "task": ["pick the cup"] * len(images)}
    policy, preprocessor, _ = load(asked)
    assert policy.config.task_template == QUESTION
    batch = preprocessor(dict(raw))
    np.testing.assert_array_equal(policy.prompt(batch).ids, ids)
    np.testing.assert_allclose(first_logits(policy, batch), expected, rtol=0, atol=2e-5)
    other, preprocessor, _ = load(bare)
    assert other.config.task_template == "{}"
    assert np.abs(first_logits(other, preprocessor(dict(raw))).numpy() - expected).max() > 1e-3


def test_small_folders_have_the_layout_of_the_authors(
    authors: tuple[Path, Path], folder: Path, original: SpatialvlaGridPolicy
) -> None:
    def layout(values: Any) -> Any:
        """Keys and kinds of values; of names, the data sets' are free."""
        if isinstance(values, dict):
            return {key: layout(value) for key, value in values.items()}
        return type(values)

    ours = [json.loads((folder / name).read_text()) for name in ("config.json", "processor_config.json")]
    theirs = [
        json.loads((authors[0] / path.name).read_text())
        for path in map(Path, ("config.json", "processor_config.json"))
    ]
    # a single kind of scene needs none of these numbers, and transformers 5 drops them
    unused = {key: None for key in theirs[0]["vision_zoe_config"] if "patch_transformer" in key}
    theirs[0]["vision_zoe_config"] |= unused
    assert layout(ours) == layout(theirs)
    with safe_open(authors[0] / "model.safetensors", "pt") as tensors:
        names = {re.sub(r"\d+", "#", name) for name in tensors.keys()}  # noqa: SIM118
    assert {re.sub(r"\d+", "#", name) for name in published_tensors(original)} == names


# Small ones


def test_the_prompt_is_said_kept_and_not_changed(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plain = converted(folder, tmp_path / "plain")
    assert (
        "prompt: the instruction alone, as the original's processor adds nothing" in capsys.readouterr().out
    )
    asked = converted(folder, tmp_path / "asked", task_template="Please {} now")
    _, preprocessor, _ = load(asked)
    written = preprocessor({**observations(1), "task": ["Pick_it"]})["observation.language.tokens"]
    assert nano_tokenizer().decode(written[0].tolist()) == "please pick it now"
    assert convert(folder, tmp_path / "refused", task_template="Please") == 1
    assert "task_template='Please' must hold {} once" in capsys.readouterr().err
    older = Path(__file__).parent / "fixtures" / "before_layout" / "spatialvla_grid"
    for checkpoint, then in ((plain, "{}"), (asked, "Please {} now"), (older, "{}")):
        with pytest.raises(ValueError, match=re.escape(f"this checkpoint was trained with {then!r}, which")):
            load(checkpoint, task_template="{}" if then != "{}" else "'now {}'")


def actions_as_the_original_decodes(
    cells: np.ndarray, processor: dict[str, Any], data_set: str
) -> np.ndarray:
    """(B, 12) cells -> (B, 4, 7): middles of bins, scaled where the data set's mask says so."""
    tokens, edges = cells.reshape(len(cells), -1, 3), processor["bin_policy"]
    first = 0
    parts = []
    for group, kind in enumerate(("translation", "rotation")):
        group_edges = [np.array(each) for each in edges[kind].values()]
        sizes = [len(each) - 1 for each in group_edges]
        bins = np.unravel_index(tokens[..., group] - first, sizes)
        parts += [(each[i] + each[i + 1]) / 2 for each, i in zip(group_edges, bins, strict=True)]
        first += np.prod(sizes)
    theta, phi, rho, *angles = parts
    xyz = rho * np.sin(theta) * np.cos(phi), rho * np.sin(theta) * np.sin(phi), rho * np.cos(theta)
    actions = np.stack([*np.clip(xyz, -1, 1), *angles, tokens[..., 2] - first], axis=-1)
    action = processor["statistics"][data_set]["action"]
    low, high = np.array(action["q01"]), np.array(action["q99"])
    return np.where(action.get("mask", [True] * 7), (actions + 1) / 2 * (high - low) + low, actions)


OTHER = {"q01": [-1, -2, -3, -1, -1, -1, -0.5], "q99": [3, 2, 1, 1, 2, 1, 1.0]}


@pytest.mark.parametrize(
    ("seed", "min_sigma", "bins", "action"),
    [
        (0, 0.0, [(16, 32, 8), (16, 16, 16)], ACTION),
        (1, 0.5, [(8, 16, 4), (8, 8, 8)], OTHER),
        (2, 0.4, [(16, 32, 8), (4, 16, 8)], OTHER | {"mask": [True, False] * 3 + [True]}),
    ],
)
def test_other_weights_edges_and_statistics_act_as_the_original(
    seed: int, min_sigma: float, bins: list[tuple[int, ...]], action: dict[str, Any], tmp_path: Path
) -> None:
    groups = ActionGroup((0, 1, 2), "polar", bins[0]), ActionGroup((3, 4, 5), "identity", bins[1])
    original = make_original(seed, min_sigma, (*groups, ActionGroup((6,), "binary", (2,))))
    statistics = {"other": {"action": ACTION}, "wanted": {"action": action}}
    folder = write_published(original, tmp_path / "published", statistics, min_sigma=min_sigma)
    checkpoint = converted(folder, tmp_path / "checkpoint", statistics="wanted")
    policy, preprocessor, postprocessor = load(checkpoint)
    assert policy.config.grid_min_sigma == min_sigma
    batch = preprocessor(observations(3, seed))
    cells = cells_of(policy, batch)
    assert torch.equal(cells, cells_of(original, batch)) and len(cells.unique()) > 6
    blind, _, _ = load(checkpoint, depth_source="none")
    assert not torch.equal(cells_of(blind, batch), cells)
    processor = json.loads((folder / "processor_config.json").read_text())
    expected = actions_as_the_original_decodes(cells.numpy(), processor, "wanted")
    actions = [postprocessor(step).numpy() for step in policy.predict_action_chunk(batch).unbind(dim=1)]
    np.testing.assert_allclose(np.stack(actions, axis=1), expected, rtol=0, atol=1e-6)


def test_weights_may_be_in_several_files(
    folder: Path, tmp_path: Path, original: SpatialvlaGridPolicy
) -> None:
    several = write_published(original, tmp_path / "several")
    (several / "model.safetensors").unlink()
    tensors = [*published_tensors(original).items()]
    for part in range(2):
        save_file(dict(tensors[part::2]), several / f"model-0000{part + 1}-of-00002.safetensors")
    weights = [
        load_file(converted(each, tmp_path / f"of_{each.name}") / "model.safetensors")
        for each in (folder, several)
    ]
    assert weights[0].keys() == weights[1].keys()
    assert all(torch.equal(tensor, weights[1][name]) for name, tensor in weights[0].items())


def test_what_nothing_reads_is_dropped(original: SpatialvlaGridPolicy, tmp_path: Path) -> None:
    folder = write_published(original, tmp_path / "published")
    head = {"vision_tower.vision_model.head.probe": torch.zeros(1, 1, 48)}
    save_file(published_tensors(original) | head, folder / "model.safetensors")
    config = published_config(original)
    del config["vision_config"]["vision_use_head"]
    (folder / "config.json").write_text(json.dumps(config))
    weights = load_file(converted(folder, tmp_path / "checkpoint") / "model.safetensors")
    assert not any("head.probe" in name for name in weights)


def test_a_folder_without_zoedepth_has_no_depth(tmp_path: Path) -> None:
    original = make_original(0, depth_source="none", depth_config=None)
    folder = write_published(original, tmp_path / "published")
    tensors = load_file(folder / "model.safetensors")
    kept = {name: tensor for name, tensor in tensors.items() if "position_embedding_3d" not in name}
    save_file(kept, folder / "model.safetensors")
    policy, preprocessor, _ = load(converted(folder, tmp_path / "checkpoint"))
    assert policy.config.depth_source == "none"
    batch = preprocessor(observations(2))
    assert torch.equal(cells_of(policy, batch), cells_of(original, batch))


# Cameras and grids


def test_another_camera_of_the_folder_is_taken_over(original: SpatialvlaGridPolicy, tmp_path: Path) -> None:
    other = {**ASSUMED, "intrinsic": [[400, 0, 320], [0, 500, 240], [0, 0, 1]]}
    cameras = {"default": ASSUMED, DATA_SET: other}
    folder = write_published(original, tmp_path / "published", intrinsic_config=cameras)
    policy, _, _ = load(converted(folder, tmp_path / "checkpoint", camera="front"))
    assert list(policy.config.input_features or {}) == ["observation.images.front"]
    # in an image of 224 pixels, from the first pixel's centre
    K = torch.tensor([[400 * 0.35, 0, 111.5], [0, 500 * 224 / 480, 111.5], [0, 0, 1]])
    torch.testing.assert_close(torch.tensor(policy.config.camera_intrinsics["front"]), K)


def test_a_grid_that_is_given_must_be_the_folders(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for seed in range(2):
        (tmp_path / f"gs_{seed}.json").write_text(json.dumps(gaussians(seed)))
    edges, output = tmp_path / "gs_0.json", tmp_path / "checkpoint"
    plain, _, _ = load(converted(folder, tmp_path / "plain"))
    assert plain.config.decode_point == "mid"
    means, _, _ = load(converted(folder, output, grid=edges, decode_point="cond_mean"))
    torch.testing.assert_close(means.grids.edges, plain.grids.edges)
    cells = torch.tensor([[[7, 8, 1]]])
    assert not torch.allclose(means.grids.decode(cells), plain.grids.decode(cells), atol=1e-3)

    def refused(message: str, **options: object) -> None:
        assert convert(folder, tmp_path / "refused", **options) == 1
        assert message in capsys.readouterr().err

    refused("gs_1.json with a least sigma of 0.0 or 0.5", grid=tmp_path / "gs_1.json")
    refused("with a least sigma of 0.9 (--min_sigma) has other edges", grid=edges, min_sigma=0.9)
    refused("--decode_point=cond_mean needs --grid", decode_point="cond_mean")


def test_the_published_grid_was_made_with_a_least_sigma_that_the_folder_does_not_say(
    authors: tuple[Path, Path], tmp_path: Path
) -> None:
    folder = authors[0]
    converted(folder, tmp_path / "checkpoint", grid=folder.parent / "gs_spatialvla_plus.json")
    assert convert(folder, tmp_path / "other", grid=folder.parent / "gs_bridge.json") == 1


def test_what_is_wrong_is_told(
    original: SpatialvlaGridPolicy, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    statistics = {"bridge": {"action": ACTION}, "fractal": {"action": ACTION}}
    folder = write_published(original, tmp_path / "published", statistics)
    processor = json.loads((folder / "processor_config.json").read_text())
    config = json.loads((folder / "config.json").read_text())

    def refused(message: str, **options: str) -> None:
        assert convert(folder, tmp_path / "checkpoint", **options) == 1
        assert message in capsys.readouterr().err
        assert not (tmp_path / "checkpoint").exists()

    refused("--statistics is missing; choose from bridge, fractal")
    refused("--statistics=other is not in the folder; choose from bridge, fractal", statistics="other")
    (folder / "config.json").write_text(json.dumps({**config, "spatial_token_num": 1026}))
    refused("has 1026 cells, but processor_config.json describes 8194", statistics="bridge")
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "processor_config.json").write_text(json.dumps({"bin_policy": None}))
    refused("processor_config.json has no statistics, action_config, action_chunk_size, intrinsic_config, so")
    (folder / "processor_config.json").write_text(json.dumps({**processor, "bin_policy": None}))
    refused("processor_config.json has no bin_policy", statistics="bridge")
    (folder / "processor_config.json").write_text(json.dumps(processor))
    tensors = published_tensors(original)
    save_file({n: t for n, t in tensors.items() if "spatial" not in n}, folder / "model.safetensors")
    refused("have no spatial_embed_tokens.weight", statistics="bridge")
    (folder / "config.json").write_text(json.dumps({**config, "model_type": "paligemma"}))
    refused("config.json is of a 'paligemma', not of a SpatialVLA")
    (folder / "processor_config.json").unlink()
    (folder / "config.json").write_text(json.dumps(config))
    refused("has no processor_config.json")
