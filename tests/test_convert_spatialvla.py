"""A folder of tiny tensors with the names and files of the published SpatialVLA."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.policies.factory import make_pre_post_processors
from safetensors.torch import save_file
from spatialvla_grid_cases import make_batch, make_policy
from torch import Tensor

from lerobot_bomb.actions.grids import ActionGrids
from lerobot_bomb.commands.main import main
from lerobot_bomb.vlm.tokenizer import nano_tokenizer
from lerobot_policy_spatialvla_grid.modeling_spatialvla_grid import SpatialvlaGridPolicy

CAMERA = "observation.images.workspace"
Q01, Q99 = [-0.02, -0.04, -0.05, -0.1, -0.1, -0.2, 0.0], [0.03, 0.05, 0.06, 0.1, 0.2, 0.2, 1.0]
Folder = tuple[Path, SpatialvlaGridPolicy]


@pytest.fixture
def published(tmp_path: Path, shared_data: Path) -> Folder:
    """As the original's code saves itself: weights in two files, and a policy of ours that acts alike."""
    grid = json.loads((shared_data / "spatialvla" / "gs_bridge.json").read_text())
    params = ActionGrids.from_published(grid, 0.5, "mid").to_dict()
    policy = make_policy(3, 7, grid_params=params, decode_point="mid", ego3d_zero_init=False)
    state = policy.state_dict()
    vlm = policy.config.vlm_config
    assert vlm is not None
    num_words = vlm["text_config"]["vocab_size"]

    def part(ours: str, theirs: str) -> dict[str, Tensor]:
        return {
            theirs + name.removeprefix(ours): x.clone() for name, x in state.items() if name.startswith(ours)
        }

    model = "backbone.vlm.model."
    unused = torch.zeros(8194, 128)  # the original's rows of cells in the table of words
    language = part(f"{model}language_model.", "language_model.model.")
    words = "language_model.model.embed_tokens.weight"
    language[words] = torch.cat([language[words], unused])
    language["language_model.lm_head.weight"] = torch.cat(
        [state["backbone.vlm.lm_head.weight"], state["cell_head.weight"]]
    )
    rest = {
        **part(f"{model}vision_tower.", "vision_tower."),
        **part(f"{model}multi_modal_projector.", "multi_modal_projector."),
        **part("ego3d.layers.", "position_embedding_3d.position_embedding_head."),
        "spatial_embed_tokens.weight": state["cell_embedding.weight"],
        "vision_zoe_model.backbone.embeddings.cls_token": torch.zeros(1, 1, 4),
    }
    folder = tmp_path / "published"
    folder.mkdir()
    save_file(language, folder / "model-00001-of-00002.safetensors")
    save_file(rest, folder / "model-00002-of-00002.safetensors")
    nano_tokenizer().save(str(folder / "tokenizer.json"))
    config = {
        "model_type": "spatialvla",
        "image_token_index": vlm["image_token_index"],
        "projection_dim": 128,
        "action_token_begin_idx": num_words,
        "spatial_token_num": 8194,
        "ego3d_patch_reso": 2,
        "n_freqs": 8,
        "text_config": {**vlm["text_config"], "vocab_size": num_words + 8194},
        "vision_config": vlm["vision_config"],
    }
    (folder / "config.json").write_text(json.dumps(config))
    action = {"q01": Q01, "q99": Q99, "mask": [True] * 6 + [False]}
    processor = {"statistics": {"bridge_orig/1.0.0": {"action": action}}, "action_chunk_size": 4}
    (folder / "processor_config.json").write_text(json.dumps(processor))
    (folder / "grid.json").write_text(json.dumps(grid))
    return folder, policy


def convert(folder: Path, output: Path, **options: str) -> int:
    options = {"statistics": "bridge_orig/1.0.0", "camera": "workspace", "decode_point": "mid", **options}
    flags = [f"--{name}={value}" for name, value in options.items()]
    return main(
        ["convert-spatialvla", str(folder), f"--output={output}", f"--grid={folder}/grid.json", *flags]
    )


def test_a_converted_checkpoint_acts_as_its_weights_say(published: Folder, tmp_path: Path) -> None:
    folder, policy = published
    assert convert(folder, tmp_path / "checkpoint") == 0
    converted = SpatialvlaGridPolicy.from_pretrained(tmp_path / "checkpoint").eval()
    assert list(converted.config.image_features) == [CAMERA]
    policy.config.input_features = converted.config.input_features
    batch = make_batch(policy, 2)
    expected = policy.predict_action_chunk(batch)
    assert torch.equal(converted.predict_action_chunk(batch), expected)
    preprocessor, postprocessor = make_pre_post_processors(converted.config, str(tmp_path / "checkpoint"))
    tasks: Any = preprocessor({CAMERA: batch[CAMERA], "task": batch["task"]})
    assert torch.equal(converted.predict_action_chunk(tasks), expected)
    # to the robot's units; the gripper's are 0 closed and 1 open
    action, low, high = expected[:, 0], torch.tensor(Q01), torch.tensor(Q99)
    torch.testing.assert_close(postprocessor(action), low + (action + 1) / 2 * (high - low))
    assert set(postprocessor(action)[:, 6].tolist()) <= {0.0, 1.0}


def test_what_is_wrong_is_told(published: Folder, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, _ = published

    def refused(message: str, **options: str) -> None:
        assert convert(folder, tmp_path / "checkpoint", **options) == 1
        assert message in capsys.readouterr().err
        assert not (tmp_path / "checkpoint").exists()

    refused("--statistics=fractal is not in the folder; choose from bridge_orig/1.0.0", statistics="fractal")
    (folder / "model-00002-of-00002.safetensors").unlink()
    refused("have no spatial_embed_tokens.weight")
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps({**config, "spatial_token_num": 1026}))
    refused("has 1026 cells, the published grid 8194")
    (folder / "config.json").write_text(json.dumps({**config, "model_type": "paligemma"}))
    refused("config.json is of a 'paligemma', not of a SpatialVLA")
    (folder / "processor_config.json").unlink()
    (folder / "config.json").write_text(json.dumps(config))
    refused("has no processor_config.json")
