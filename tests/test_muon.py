"""Muon: its steps beside torch's, which parameters take them, and the flag that chooses it."""

import fdvla_cases
import pytest
import spatialvla_grid_cases
import torch
import vla0_smol_cases
from torch import Tensor, nn

from lerobot_bomb.flag_errors import FlagError
from lerobot_bomb.training.muon import IS_MATRIX, STEP_RMS, MuonConfig, orthogonal, parameter_groups

LR, DECAY = 0.01, 0.1
# of Liu et al., which torch's has
TORCH_RMS = 0.2


def parameters_and_gradients(*shapes: tuple[int, ...]) -> tuple[list[nn.Parameter], list[list[Tensor]]]:
    generator = torch.Generator().manual_seed(0)
    parameters = [nn.Parameter(torch.randn(shape, generator=generator)) for shape in shapes]
    return parameters, [[torch.randn(shape, generator=generator) for shape in shapes] for _ in range(4)]


def train(
    optimizer: torch.optim.Optimizer, parameters: list[nn.Parameter], steps: list[list[Tensor]]
) -> None:
    for gradients in steps:
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter.grad = gradient.clone()
        optimizer.step()


@pytest.mark.parametrize("shape", [(5, 40, 90), (5, 90, 40), (1, 64, 64)])
def test_singular_values_come_near_one_and_vectors_stay(shape: tuple[int, int, int]) -> None:
    matrices = torch.randn(shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    left, values, right = torch.linalg.svd(matrices, full_matrices=False)
    found = orthogonal(matrices).double()
    assert values.max() > 5
    along = (left.mT @ found @ right.mT).diagonal(dim1=-2, dim2=-1)
    assert (found - left @ torch.diag_embed(along) @ right).abs().max() < 1e-4
    assert along[values > 0.02 * values.amax(dim=-1, keepdim=True)].min() > 0.65
    assert along.max() < 1.25


def test_matrices_step_as_torchs_muon_does() -> None:
    shapes = (64, 64), (40, 90), (90, 40), (64, 64)
    ours, steps = parameters_and_gradients(*shapes)
    torchs, _ = parameters_and_gradients(*shapes)
    train(MuonConfig(lr=LR, weight_decay=DECAY).build(ours), ours, steps)
    rate = LR * STEP_RMS / TORCH_RMS
    flags = {"lr": rate, "weight_decay": DECAY * LR / rate, "adjust_lr_fn": "match_rms_adamw"}
    train(torch.optim.Muon(torchs, **flags), torchs, steps)
    start, _ = parameters_and_gradients(*shapes)
    for our, other, before in zip(ours, torchs, start, strict=True):
        moved = (other - before).norm()
        assert moved > 0.1
        assert (our - other).norm() < 0.02 * moved  # torch's iteration runs in bfloat16


def test_all_else_steps_as_torchs_adamw_does() -> None:
    shapes = (7,), (3, 2, 2), ()
    ours, steps = parameters_and_gradients(*shapes)
    torchs, _ = parameters_and_gradients(*shapes)
    flags = {"lr": LR, "weight_decay": DECAY, "betas": (0.9, 0.95), "eps": 1e-8}
    train(MuonConfig(**flags).build(ours), ours, steps)
    train(torch.optim.AdamW(torchs, **flags), torchs, steps)
    for our, other in zip(ours, torchs, strict=True):
        assert torch.equal(our, other)


@pytest.mark.parametrize(
    ("make_policy", "outputs"),
    [
        (vla0_smol_cases.make_policy, ("lm_head", "embed_tokens", "position_embedding")),
        (spatialvla_grid_cases.make_policy, ("cell_head", "cell_embedding", "embed_tokens")),
        (fdvla_cases.make_policy, ("embed_tokens", "flow_head.out", "denoise_head.out", "patch_embed")),
    ],
)
def test_hidden_layers_are_muons_and_inputs_and_outputs_adamws(make_policy, outputs: tuple[str, ...]) -> None:
    policy = make_policy(optimizer="muon")
    frozen = next(p for p in policy.parameters() if p.requires_grad)
    frozen.requires_grad_(False)
    names = {parameter: name for name, parameter in policy.named_parameters()}
    groups = {group[IS_MATRIX]: {names[p] for p in group["params"]} for group in policy.get_optim_params()}
    assert groups[True] | groups[False] == {n for p, n in names.items() if p.requires_grad}
    assert not groups[True] & groups[False]
    for name in outputs:
        assert not any(name in each for each in groups[True]), name
        assert any(name in each for each in names.values()), name
    layers = "q_proj", "o_proj", "up_proj", "down_proj"
    text = [n for n in groups[True] if n.rpartition(".")[0].endswith(layers) and "layers" in n]
    assert len(text) >= len(layers)
    assert policy.config.get_optimizer_preset().type == "muon_adamw"


def test_tied_embeddings_are_adamws() -> None:
    words, hidden, scores = nn.Embedding(40, 64), nn.Linear(64, 64), nn.Linear(64, 40, bias=False)
    scores.weight = words.weight
    groups = {
        group[IS_MATRIX]: group["params"] for group in parameter_groups(nn.Sequential(words, hidden, scores))
    }
    assert [id(parameter) for parameter in groups[True]] == [id(hidden.weight)]
    assert {id(parameter) for parameter in groups[False]} == {id(words.weight), id(hidden.bias)}


def test_a_matrix_that_was_split_is_an_error() -> None:
    flat = nn.Parameter(torch.ones(12))
    optimizer = MuonConfig().build([{"params": [flat], IS_MATRIX: True}])
    flat.grad = torch.ones(12)
    with pytest.raises(RuntimeError, match=r"FSDP splits; give --policy\.optimizer=adamw"):
        optimizer.step()


def test_another_optimizer_is_an_error() -> None:
    with pytest.raises(FlagError, match=r"--policy\.optimizer=.sgd. is unknown; choose one of: adamw, muon"):
        fdvla_cases.make_config(4, optimizer="sgd")
