from pathlib import Path

import pytest
import spatialvla_grid_cases
import torch
from lerobot.policies.factory import make_pre_post_processors
from vla0_smol_cases import STATS, make_policy, raw_batch

from lerobot_bomb.commands.main import main
from lerobot_policy_spatialvla_grid.modeling_spatialvla_grid import SpatialvlaGridPolicy
from lerobot_policy_vla0_smol import make_vla0_smol_pre_post_processors


def test_an_exported_backbone_is_where_another_policy_starts(tmp_path: Path) -> None:
    policy = make_policy()
    with torch.no_grad():  # as if it had learned: not the weights that a fresh one draws
        for weight in policy.parameters():
            weight.add_(0.01)
    policy.save_pretrained(tmp_path / "checkpoint")
    for pipeline in make_vla0_smol_pre_post_processors(policy.config, STATS):
        pipeline.save_pretrained(tmp_path / "checkpoint")
    base = tmp_path / "base"
    flags = [f"--policy.path={tmp_path / 'checkpoint'}", f"--output={base}"]
    assert main(["export-backbone", *flags]) == 0
    other = make_policy(vlm_model_name=str(base), relative_actions=True, chunk_size=4, use_state=False)
    weights = other.backbone.state_dict()
    assert weights and all(torch.equal(weights[k], w) for k, w in policy.backbone.state_dict().items())
    assert other.tokens == policy.tokens
    preprocessors = [make_vla0_smol_pre_post_processors(p.config, STATS)[0] for p in (policy, other)]
    ids = [preprocessor(raw_batch(2))["observation.language.tokens"] for preprocessor in preprocessors]
    assert torch.equal(*ids)
    assert main(["export-backbone", *flags]) == 1  # not over an existing folder


def test_a_paligemma_is_exported_alike(tmp_path: Path) -> None:
    policy = spatialvla_grid_cases.make_policy(7)
    policy.save_pretrained(tmp_path / "checkpoint")
    for pipeline in make_pre_post_processors(policy.config, dataset_stats=spatialvla_grid_cases.stats()):
        pipeline.save_pretrained(tmp_path / "checkpoint")
    base = tmp_path / "base"
    assert main(["export-backbone", f"--policy.path={tmp_path / 'checkpoint'}", f"--output={base}"]) == 0
    config = spatialvla_grid_cases.make_config(num_dims=2)
    config.vlm_model_name = str(base)
    other = SpatialvlaGridPolicy(config)
    weights = other.backbone.state_dict()
    assert weights and all(torch.equal(weights[k], w) for k, w in policy.backbone.state_dict().items())
    assert other.tokens == policy.tokens


def test_a_checkpoint_without_such_a_model_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export-backbone", f"--policy.path={tmp_path}", f"--output={tmp_path / 'base'}"]) == 1
    assert "holds no config.json" in capsys.readouterr().err
    assert not (tmp_path / "base").exists()
