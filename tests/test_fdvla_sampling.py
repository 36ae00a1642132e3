"""Sampling of `fdvla`: every sampler, its noise, the queue, real-time chunking."""

from typing import Any

import pytest
import torch
from fdvla_cases import make_batch, make_config, make_policy, rows
from flow_cases import gaussian_heads
from lerobot.policies.rtc import RTCConfig, RTCProcessor
from lerobot.rollout.inference.rtc import supports_rtc_inference
from torch import Tensor

from lerobot_bomb.flow.real_time import guided
from lerobot_bomb.flow.samplers import SAMPLERS, sample
from lerobot_policy_bomb.fdvla.modeling_fdvla import FdvlaPolicy

OPTIONS: list[dict[str, Any]] = [
    *({"sampler": sampler} for sampler in SAMPLERS),
    {"sampler": "residual", "solver": "heun"},
    {"use_denoise_head": False},
    {"use_flow_head": False},
]


def ids(options: dict[str, Any]) -> str:
    return "-".join(map(str, options.values()))


def draw(policy: FdvlaPolicy, batch_size: int, seed: int = 1) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(batch_size, policy.config.chunk_size, policy.action_dim, generator=generator)


@torch.no_grad()
@pytest.mark.parametrize("options", OPTIONS, ids=ids)
def test_a_chunk_is_what_the_sampler_makes_of_the_heads(options: dict[str, Any]) -> None:
    policy = make_policy(**options, num_inference_steps=4, refine_alpha=0.5)
    batch, noise = make_batch(policy, 2), draw(make_policy(), 2)
    context = policy._read(batch)
    chosen = {name: options[name] for name in ("sampler", "solver") if name in options}
    name = chosen.setdefault("sampler", "ddim" if policy.flow_head is None else "flow")
    generator = torch.Generator().manual_seed(0)
    step_noise = torch.randn(4, 4, 4, generator=generator).expand(2, -1, -1, -1) if name == "sde" else None
    expected = sample(
        policy._heads(context),
        noise,
        num_inference_steps=4,
        refine_alpha=0.5,
        step_noise_BNKD=step_noise,
        **chosen,
    )
    actual = policy.predict_action_chunk(batch, noise)
    assert actual.shape == (2, 4, 4) and actual.dtype == torch.float32
    torch.testing.assert_close(actual, expected, rtol=0, atol=1e-5)


def test_samplers_differ() -> None:
    batch = make_batch(make_policy(), 2)
    chunks = [
        make_policy(sampler=name).predict_action_chunk(batch, draw(make_policy(), 2)) for name in SAMPLERS
    ]
    for i, one in enumerate(chunks):
        assert not any(torch.allclose(one, other, atol=1e-3) for other in chunks[:i])


def test_without_refinement_the_residual_sampler_is_the_flow() -> None:
    residual, flow = make_policy(refine_alpha=0.0), make_policy(sampler="flow")
    batch, noise = make_batch(flow, 2), draw(flow, 2)
    assert torch.equal(residual.predict_action_chunk(batch, noise), flow.predict_action_chunk(batch, noise))


@pytest.mark.parametrize("sampler", ["residual", "sde"])
def test_a_rows_actions_depend_on_nothing_but_the_row(sampler: str) -> None:
    policy = make_policy(sampler=sampler)
    batch = make_batch(policy, 3)

    def predict(which: list[int]) -> Tensor:
        policy.reset()
        return policy.predict_action_chunk(rows(batch, which))

    together = predict([0, 1, 2])
    torch.testing.assert_close(predict([2, 0, 1]), together[[2, 0, 1]], rtol=0, atol=1e-5)
    for row in range(3):
        torch.testing.assert_close(predict([row]), together[row : row + 1], rtol=0, atol=1e-5)


def test_noise_is_drawn_anew_until_an_episode_ends() -> None:
    policy = make_policy()
    batch = make_batch(policy, 1)
    first, second = policy.predict_action_chunk(batch), policy.predict_action_chunk(batch)
    assert not torch.allclose(first, second, atol=1e-3)
    torch.manual_seed(5)  # nor anyone else's randomness
    policy.reset()
    assert torch.equal(policy.predict_action_chunk(batch), first)
    assert torch.equal(policy.predict_action_chunk(batch), second)


def test_an_episode_has_its_own_noise_if_asked_for() -> None:
    policy = make_policy(noise_per_episode=True)
    batch = rows(make_batch(policy, 1), [0, 0])
    policy.reset()
    together = policy.predict_action_chunk(batch)
    assert not torch.allclose(together[0], together[1], atol=1e-3)
    again = make_policy(noise_per_episode=True)
    again.load_state_dict(policy.state_dict())
    for row in range(2):  # one by one they are the same episodes
        again.reset()
        torch.testing.assert_close(
            again.predict_action_chunk(rows(batch, [row])), together[row : row + 1], rtol=0, atol=1e-5
        )
    other = make_policy(noise_seed=1)
    other.load_state_dict(policy.state_dict())
    one = make_policy()
    one.load_state_dict(policy.state_dict())
    assert not torch.allclose(other.predict_action_chunk(batch), one.predict_action_chunk(batch), atol=1e-3)


def test_noise_of_another_shape_is_refused() -> None:
    policy = make_policy()
    with pytest.raises(ValueError, match=r"noise has shape \(4, 4\); expected \(2, 4, 4\)"):
        policy.predict_action_chunk(make_batch(policy, 2), torch.zeros(4, 4))


def test_actions_are_queued_and_forgotten_on_reset() -> None:
    policy = make_policy(n_action_steps=2)
    first, second = make_batch(policy, 2, seed=1), make_batch(policy, 2, seed=2)
    chunks = [policy.predict_action_chunk(batch) for batch in (first, second)]
    policy.reset()
    assert torch.equal(policy.select_action(first), chunks[0][:, 0])
    assert torch.equal(policy.select_action(second), chunks[0][:, 1])  # still of the first prediction
    assert torch.equal(policy.select_action(second), chunks[1][:, 0])
    policy.reset()
    assert torch.equal(policy.select_action(first), chunks[0][:, 0])
    noise = draw(policy, 2)
    policy.reset()
    action = policy.select_action(second, noise=noise)
    assert torch.equal(action, policy.predict_action_chunk(second, noise)[:, 0])


def test_dropped_actions_are_predicted_anew() -> None:
    policy = make_policy(n_action_steps=2)
    first, second = make_batch(policy, 2, seed=1), make_batch(policy, 2, seed=2)
    chunks = [policy.predict_action_chunk(batch) for batch in (first, second)]
    policy.reset()
    policy.drop_queued_actions()
    assert torch.equal(policy.select_action(first), chunks[0][:, 0])
    policy.drop_queued_actions()
    assert torch.equal(policy.select_action(second), chunks[1][:, 0])


def test_the_prompt_is_read_once_and_the_segment_at_every_step(monkeypatch: pytest.MonkeyPatch) -> None:
    policy = make_policy(num_inference_steps=5)
    shapes: dict[str, list[tuple[int, ...]]] = {"read_prefix": [], "read_segment": []}
    for name, seen in shapes.items():
        read = getattr(policy.backbone, name)

        def note(*args: Any, read: Any = read, seen: list = seen) -> Any:
            seen.extend(tuple(arg.shape) for arg in args if isinstance(arg, Tensor) and arg.ndim == 3)
            return read(*args)

        monkeypatch.setattr(policy.backbone, name, note)
    policy.predict_action_chunk(make_batch(policy, 2))
    assert len(shapes["read_prefix"]) == 1
    assert shapes["read_segment"] == 5 * [(2, 7, 128), (2, 7, 7)]


def test_training_goes_on_after_evaluation_inside_one_autocast() -> None:
    policy = make_policy(dtype="bfloat16")
    batch = make_batch(policy, 2)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        with torch.inference_mode():
            assert policy.select_action(batch).dtype == torch.float32
        policy.train()(batch)[0].backward()
    assert policy.segment.marks.grad is not None


# Real-time chunking


def test_a_new_chunk_goes_on_from_what_is_left() -> None:
    """Guided by all of the last chunk, the next one comes nearer to it; without one, nothing changes."""
    policy = make_policy(num_inference_steps=10)
    batch, noise, left = make_batch(policy, 1), draw(make_policy(), 1), 2 * draw(make_policy(), 1, seed=2)
    free = policy.predict_action_chunk(batch, noise)
    assert supports_rtc_inference(policy)
    # as lerobot-rollout does: the config is changed after the policy was made
    policy.config.rtc_config = RTCConfig(execution_horizon=4)
    policy.init_rtc_processor()
    first = policy.predict_action_chunk(batch, noise, inference_delay=0, prev_chunk_left_over=None)
    assert torch.equal(first, free)
    with torch.inference_mode():
        following = policy.predict_action_chunk(batch, noise, inference_delay=4, prev_chunk_left_over=left[0])
    assert (following - left).abs().mean() < 0.1 * (free - left).abs().mean()
    partly = policy.predict_action_chunk(batch, noise, inference_delay=1, prev_chunk_left_over=left[0, :2])
    assert (partly - left)[:, 0].abs().mean() < 0.2 * (free - left)[:, 0].abs().mean()
    # lerobot-rollout fills up with zeros, here beyond the chunk, and also where nothing is left
    for kept, expected in ((2, partly), (0, free)):
        filled = torch.cat([left[0, :kept], torch.zeros(10 - kept, 4)])
        got = policy.predict_action_chunk(batch, noise, inference_delay=1, prev_chunk_left_over=filled)
        assert torch.equal(got, expected)


@pytest.mark.parametrize("refine_alpha", [0.3, 1.0])
def test_guidance_is_not_taken_back(refine_alpha: float) -> None:
    """Check that `residual` is `flow` where the heads agree, guided or not."""
    heads, noise, left = gaussian_heads(0.0, 0.5), draw(make_policy(), 1), torch.ones(4, 4)
    processor = RTCProcessor(RTCConfig(execution_horizon=4))
    flow, residual = (
        sample(guided(heads, processor, left, 2), noise, sampler=sampler, refine_alpha=refine_alpha)
        for sampler in ("flow", "residual")
    )
    torch.testing.assert_close(residual, flow)
    assert (flow - left).abs().mean() < 0.5 * (sample(heads, noise) - left).abs().mean()


def test_real_time_chunking_needs_a_velocity() -> None:
    policy = make_policy(use_flow_head=False)
    assert not policy.supports_rtc() and not supports_rtc_inference(policy)
    with pytest.raises(ValueError, match=r"sampler=ddim has none; give --policy\.sampler=flow or residual"):
        make_policy(sampler="ddim", rtc_config=RTCConfig())
    assert make_policy(sampler="ddim", rtc_config=RTCConfig(enabled=False)).rtc_processor is None
    assert make_config(rtc_config=RTCConfig()).rtc_config is not None
