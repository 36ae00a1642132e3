"""Training a converted SpatialVLA on other data: LoRA on adapted grids, by LeRobot's own commands."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.policies import make_policy
from published_spatialvla import CAMERA, converted, load, make_original, observations, write_published
from safetensors.torch import load_file

from lerobot_bomb.checkpoints.folder import read_config
from lerobot_bomb.commands.main import main
from lerobot_policy_bomb.spatialvla_grid.modeling_spatialvla_grid import SpatialvlaGridPolicy

pytest.importorskip("peft")

LORA = {"method_type": "LORA", "r": 4}
REPO_ID = "test/deltas"
NAMES = ["x", "y", "z", "roll", "pitch", "yaw", "gripper"]


def make_dataset(root: Path, spread: float) -> LeRobotDatasetMetadata:
    """An episode of pose deltas, whose size differs between the dimensions."""
    features = {
        "action": {"dtype": "float32", "shape": (7,), "names": NAMES},
        CAMERA: {"dtype": "image", "shape": (32, 32, 3), "names": ["height", "width", "channels"]},
    }
    dataset = LeRobotDataset.create(REPO_ID, fps=10, features=features, root=root, use_videos=False)
    generator = np.random.default_rng(0)
    for _ in range(8):
        action = generator.normal(0.1, spread, 7) ** 3
        action[6] = generator.integers(2)
        pixels = generator.integers(0, 256, (32, 32, 3), dtype=np.uint8)
        dataset.add_frame({"action": action.astype(np.float32), CAMERA: pixels, "task": "pick the cup"})
    dataset.save_episode()
    dataset.finalize()
    return LeRobotDatasetMetadata(REPO_ID, root=root)


@pytest.fixture(scope="module")
def meta(tmp_path_factory: pytest.TempPathFactory) -> LeRobotDatasetMetadata:
    return make_dataset(tmp_path_factory.mktemp("deltas") / "dataset", 0.3)


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("published")
    return converted(write_published(make_original(0), folder / "tiny"), folder / "checkpoint")


def adapted(base: Path, meta: LeRobotDatasetMetadata, **flags: object) -> SpatialvlaGridPolicy:
    """Load a policy as `lerobot-train --policy.path` has it before it adds adapters."""
    overrides = [f"--{name}={value}" for name, value in flags.items()]
    config: Any = PreTrainedConfig.from_pretrained(base, cli_overrides=overrides)
    config.pretrained_path = base
    return SpatialvlaGridPolicy.from_pretrained(base, config=config, dataset_meta=meta)


def test_adapters_hold_the_cells_of_adapted_grids(
    base: Path, meta: LeRobotDatasetMetadata, stock_cli: Callable[..., None], tmp_path: Path
) -> None:
    """Train, resume, load on the base and merge: the grids are those of the new data everywhere."""
    flags = f"--policy.path={base} --dataset.repo_id={REPO_ID} --dataset.root={meta.root} --batch_size=2"
    flags += " --num_workers=0 --steps=2 --save_freq=1 --peft.method_type=LORA --peft.r=4 --peft.lora_alpha=4"
    flags += " --peft.init_type=gaussian --policy.optimizer_lr=5e-4 --policy.scheduler_warmup_steps=0"
    stock_cli("lerobot-train", *flags.split(), f"--output_dir={tmp_path / 'whole'}")
    whole, again = (tmp_path / each / "checkpoints" for each in ("whole", "again"))
    shutil.copytree(whole / "000001", again / "000001")
    config_path = again / "000001" / "pretrained_model" / "train_config.json"
    stock_cli(
        "lerobot-train", f"--config_path={config_path}", "--resume=true", f"--output_dir={again.parent}"
    )
    folders = [each / "last" / "pretrained_model" for each in (whole, again)]
    weights, resumed = (load_file(each / "adapter_model.safetensors") for each in folders)
    assert weights.keys() == resumed.keys()
    assert all(torch.equal(resumed[name], tensor) for name, tensor in weights.items())
    expected = adapted(base, meta)
    table = next(tensor for name, tensor in weights.items() if "cell_head" in name)
    assert (table - expected.cell_head.weight).abs().max() < 0.01  # of two steps, from the adapted ones
    config: Any = read_config(folders[0], "cpu")
    assert config.grid_params == expected.config.grid_params
    assert config.grid_params != load(base)[0].config.grid_params
    assert (
        main(["checkpoint", "merge", f"--policy.path={folders[0]}", f"--output={tmp_path / 'merged'}"]) == 0
    )
    wrapped = make_policy(config, ds_meta=meta).eval()
    merged, preprocessor, _ = load(tmp_path / "merged")
    assert merged.grids.to_dict() == expected.grids.to_dict()
    batch = preprocessor(observations(2))
    actions = wrapped.predict_action_chunk(batch)
    torch.testing.assert_close(merged.predict_action_chunk(batch), actions, atol=1e-4, rtol=0)
    with pytest.raises(ValueError, match=r"holds adapters and cells of other grids .* checkpoint merge"):
        make_policy(read_config(folders[0], "cpu"), ds_meta=make_dataset(tmp_path / "other", 0.6))


def test_adapters_are_where_the_original_has_them(base: Path, meta: LeRobotDatasetMetadata) -> None:
    """Check every linear layer that the original's fine-tuning names, by the names there."""
    theirs = (
        "q_proj k_proj v_proj o_proj gate_proj up_proj down_proj fc1 fc2 out_proj linear layers.0 layers.3"
    )

    def with_adapters(**flags: object) -> set[str]:
        wrapped: Any = adapted(base, meta, **flags).wrap_with_peft(peft_cli_overrides=LORA)
        return {*wrapped.targeted_module_names}

    policy = adapted(base, meta)
    parts = ("backbone.vlm.model.language_model", "backbone.vlm.model.vision_tower")
    expected = {
        name
        for name, module in policy.named_modules()
        if isinstance(module, torch.nn.Linear)
        and name.startswith((*parts, "backbone.vlm.model.multi_modal_projector", "ego3d"))
        and name.endswith(tuple(f".{suffix}" for suffix in theirs.split()))
    }
    found = with_adapters()
    assert found == expected and len(expected) == 2 * 7 + 2 * 6 + 1 + 2
    frozen = with_adapters(freeze_vision_encoder="true", depth_source="none")
    assert frozen == {name for name in expected if "vision_tower" not in name and "ego3d" not in name}


def test_data_without_depth_cannot_be_trained_on_with_observed_depth(
    base: Path, meta: LeRobotDatasetMetadata
) -> None:
    with pytest.raises(ValueError, match=r"needs observation\.depth\.image, observation\.intrinsics\.image"):
        adapted(base, meta, depth_source="observation")


def test_adapters_that_could_not_hold_adapted_cells_are_refused(
    base: Path, meta: LeRobotDatasetMetadata
) -> None:
    with pytest.raises(ValueError, match=r"full_training_modules=\['ego3d'\] leaves out the cells, which"):
        adapted(base, meta).wrap_with_peft(peft_cli_overrides={**LORA, "full_training_modules": ["ego3d"]})
    groups = load(base)[0].config.action_groups
    assert groups is not None
    groups[1]["bins"] = [8, 8, 8]
    other = adapted(base, meta, action_groups=str(groups).replace("'", '"'))
    with pytest.raises(ValueError, match=r"grids of \[4096, 512, 2\] cells, as .* have \[4096, 4096, 2\]"):
        other.wrap_with_peft(peft_cli_overrides=LORA)
    kept = adapted(base, meta, adapt_embeddings="false")
    assert kept.wrap_with_peft(peft_cli_overrides={**LORA, "full_training_modules": []}).config.use_peft
