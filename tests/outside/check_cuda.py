"""Answers that are captured on a GPU; `make test-cuda` runs this where one is, CI has none."""

import copy
import pickle
from collections.abc import Callable, Iterator
from typing import Any

import explain_cases
import fdvla_cases
import pytest
import spatialvla_grid_cases
import torch
import vla0_smol_cases
from policy_cases import CASES
from torch import Tensor

from lerobot_bomb.explain.moment import explain
from lerobot_bomb.finite import require_finite_batch

WRITERS = {
    "vla0_smol, drafts": lambda **options: vla0_smol_cases.make_policy(**options),
    "vla0_smol, no drafts": lambda **options: vla0_smol_cases.make_policy(draft="none", **options),
    "spatialvla_grid": lambda **options: spatialvla_grid_cases.make_policy(0, 7, **options),
    "spatialvla_grid, causal": lambda **options: spatialvla_grid_cases.make_policy(
        0, 7, prefix_attention="causal", use_state=True, **options
    ),
}
SAMPLERS = {
    # near noise ddim divides by tau: what an untrained network is off by is more than all of the actions
    f"fdvla, {sampler}": lambda sampler=sampler, **options: fdvla_cases.make_policy(
        0, 7, sampler=sampler, denoise_tau_min=0.5, **options
    )
    for sampler in ("residual", "ddim", "sde")
}


@pytest.fixture(params=WRITERS)
def make_writer(request: pytest.FixtureRequest) -> Callable[..., Any]:
    return WRITERS[request.param]


@pytest.fixture(params=WRITERS | SAMPLERS)
def make(request: pytest.FixtureRequest) -> Callable[..., Any]:
    return (WRITERS | SAMPLERS)[request.param]


@pytest.fixture(autouse=True)
def exact() -> Iterator[None]:
    if not torch.cuda.is_available():
        pytest.exit("these checks need a CUDA device, and none is there", returncode=1)
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = False
    yield


def batch_for(policy: Any, batch_size: int, seed: int = 0) -> dict[str, Any]:
    return CASES[policy.name].make_batch(policy, batch_size, seed)


def on(device: str, batch: dict[str, Any]) -> dict[str, Any]:
    return {key: value.to(device) if isinstance(value, Tensor) else value for key, value in batch.items()}


def predict(policy: Any, batch: dict[str, Any]) -> Tensor:
    device = str(next(policy.parameters()).device)
    policy.reset()  # noise that is sampled from
    return policy.predict_action_chunk(on(device, batch)).cpu()


def same(actions: Tensor, others: Tensor) -> bool:
    """Return True for the same choices, decoded on either device; neighbours are farther apart."""
    return torch.allclose(actions, others, rtol=0, atol=2e-4)


def test_a_gpu_answers_as_a_cpu_does(make: Callable[..., Any]) -> None:
    host = make()
    device = copy.deepcopy(host).cuda()
    for batch_size in (1, 5, 1, 16):
        for seed in range(3):
            batch = batch_for(host, batch_size, seed)
            with torch.inference_mode(seed % 2 == 0):
                assert same(predict(device, batch), predict(host, batch))


def test_so_do_compiled_layers(make_writer: Callable[..., Any]) -> None:
    host, device = make_writer(), make_writer(compile_model=True).cuda()
    for seed in range(3):
        batch = batch_for(host, 3, seed)
        assert same(predict(device, batch), predict(host, batch))


def test_fewer_actions_are_the_first_of_more(make: Callable[..., Any]) -> None:
    device = make(n_action_steps=2).cuda()
    batch = on("cuda", batch_for(device, 4))
    chunk = device.predict_action_chunk(batch)
    device.reset()
    assert torch.equal(device.select_action(batch), chunk[:, 0])
    assert torch.equal(device.select_action(batch), chunk[:, 1])


def test_graphs_follow_weights_and_devices(make: Callable[..., Any]) -> None:
    host = make()
    device, batch = copy.deepcopy(host).cuda(), batch_for(host, 2)
    first = predict(device, batch)
    with torch.no_grad():
        for policy in (host, device):
            for parameter in policy.parameters():
                parameter.data.mul_(1.3)
    second = predict(device, batch)
    assert same(second, predict(host, batch)) and not same(second, first)
    for moved in (device.cpu().cuda(), copy.deepcopy(device), pickle.loads(pickle.dumps(device))):
        assert torch.equal(predict(moved, batch), second)


def test_what_a_model_gives_that_is_not_finite_is_no_action(make: Callable[..., Any]) -> None:
    """Check one bad row, and another call of the same graph."""
    device = make().cuda()
    batch = on("cuda", batch_for(device, 3))
    device.predict_action_chunk(batch)
    key = next(key for key in batch if key.startswith("observation.images"))
    spoiled = {**batch, key: batch[key].index_fill(0, torch.tensor([1], device="cuda"), torch.nan)}
    with pytest.raises(ValueError, match=r"NaN or infinite numbers for the rows \[1\] of the batch"):
        device.predict_action_chunk(spoiled)
    device.predict_action_chunk(batch)
    for parameter in device.parameters():
        torch.nn.init.constant_(parameter, torch.nan)
    with pytest.raises(ValueError, match=r"NaN or infinite numbers for the rows \[0, 1, 2\] of the batch"):
        device.predict_action_chunk(batch)


def test_a_batch_on_the_device_is_checked_where_it_lies() -> None:
    values = {"a": torch.zeros(2, 3, device="cuda"), "b": torch.zeros(2, 5, device="cuda")}
    frames = {"index": torch.tensor([5, 6]), "episode_index": torch.tensor([0, 1], device="cuda")}
    require_finite_batch(values, frames)
    values["b"][1, 4] = torch.inf
    with pytest.raises(ValueError, match=r"'b' is not finite in frame 6 .* of episode 1, row 1"):
        require_finite_batch(values, frames)


def test_training_goes_on_after_a_prediction(make: Callable[..., Any]) -> None:
    for dtype in ("float32", "bfloat16"):
        device = make(dtype=dtype).cuda()
        batch = on("cuda", batch_for(device, 2))
        optimizer = torch.optim.SGD(device.get_optim_params(), lr=1e-3)
        for _ in range(2):
            device.train()
            loss, _ = device.forward(batch)
            loss.backward()
            optimizer.step()
            optimizer.zero_grad()
            with torch.inference_mode():
                assert device.predict_action_chunk(batch).isfinite().all()


def test_in_bfloat16_it_answers_nearly_the_same(make_writer: Callable[..., Any]) -> None:
    """Check that most of the likeliest choices stay so."""
    host, device = make_writer(), make_writer(dtype="bfloat16").cuda()
    batches = [batch_for(host, 8, seed) for seed in range(4)]
    same = torch.cat([predict(host, batch) == predict(device, batch) for batch in batches])
    assert 0.3 < same.float().mean() < 1


@pytest.mark.parametrize("train_vlm", ["full", "frozen"])
def test_sampling_in_bfloat16_is_as_near_as_kernel_by_kernel(train_vlm: str) -> None:
    options = {"sampler": "residual", "train_vlm": train_vlm}
    host = fdvla_cases.make_policy(0, 7, **options)
    device = fdvla_cases.make_policy(0, 7, dtype="bfloat16", **options).cuda()
    batch = batch_for(host, 4)
    exact, captured = predict(host, batch), predict(device, batch)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(device, "_captured", lambda _, *tensors: device._sample(*tensors))
        eager = predict(device, batch)
    error, error_of_eager = ((actions - exact).abs().max() for actions in (captured, eager))
    assert 0 < error < 2 * error_of_eager + 1e-3


@pytest.mark.parametrize("name", explain_cases.NAMES)
def test_an_explanation_on_a_gpu_is_that_of_a_cpu(name: str) -> None:
    policies = [explain_cases.fresh(name, device) for device in ("cpu", "cuda")]
    host, device = (explain(explain_cases.ask(each), explain_cases.query(each)) for each in policies)
    scores: dict[str, Any] = {"rel": 1e-3, "abs": 1e-3 * abs(host.clean_score)}
    assert device.clean_score == pytest.approx(host.clean_score, **scores)
    for key, map_GG in host.patches.items():
        assert device.patches[key].flatten().tolist() == pytest.approx(map_GG.flatten().tolist(), **scores)
    assert device.words == pytest.approx(host.words, **scores)
    assert device.others == pytest.approx(host.others, **scores)
    names = [each.corruption for each in host.restored]
    assert names == [each.corruption for each in device.restored] and names
    for each, other in zip(host.restored, device.restored, strict=True):
        if abs(each.drop) > 1e-2 * abs(host.clean_score):  # a smaller one's ratios are of its rounding
            heads = [ratio for layer in each.heads for ratio in layer]
            others = [ratio for layer in other.heads for ratio in layer]
            assert others == pytest.approx(heads, abs=2e-2)
