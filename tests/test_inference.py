"""Latency and smoothness of a policy, on the records of its episodes."""

import gc
import json
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import fields, replace
from math import ceil
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from weakref import ref

import numpy as np
import pytest
import torch
from lerobot.policies import PreTrainedPolicy, make_policy
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from policy_cases import CASES
from result_rows import read, values

import lerobot_policy_bomb  # noqa: F401  the plugin
from lerobot_bomb.bomb.observation import RenderOptions
from lerobot_bomb.checkpoints import queries
from lerobot_bomb.checkpoints.queries import last_query, time_queries
from lerobot_bomb.commands.main import main
from lerobot_bomb.compat.hooks import policies as built
from lerobot_bomb.results.bomb import EpisodeResult
from lerobot_bomb.results.efficiency import efficiencies
from lerobot_bomb.results.groups import read_results
from lerobot_bomb.results.inference import Inference, Query
from lerobot_bomb.results.record import MEASURED, different_fields
from lerobot_bomb.smoothness import smoothness
from lerobot_env_bomb.bomb.configuration_bomb import BombEnvConfig
from lerobot_env_bomb.bomb.env import BombEnv
from lerobot_policy_bomb.bomb_random.configuration_bomb_random import BombRandomConfig

SMALL = RenderOptions(image_size=32)
ENV = BombEnvConfig(image_size=32, fps=1)  # episodes of 10 steps
QUERY = Query(seconds=0.5, passes=3, tokens=7.0, num_parameters=5, peak_memory_bytes=None, device="cpu")
SMOOTH = ("action_j2", "action_j3")
ACT_BATCH = {
    "observation.images.workspace": torch.zeros(2, 3, 32, 32),
    "observation.images.wrist": torch.zeros(2, 3, 32, 32),
    "observation.state": torch.zeros(2, 4),
}


@pytest.fixture(autouse=True)
def no_policy_of_other_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(built, "_BUILT", [])


def make_act(**flags: Any) -> PreTrainedPolicy:
    small: dict[str, Any] = {"dim_model": 8, "n_heads": 1, "dim_feedforward": 8, "chunk_size": 4}
    small |= {"n_action_steps": 4, "device": "cpu", "pretrained_backbone_weights": None, "use_vae": False}
    torch.manual_seed(0)
    return make_policy(ACTConfig(**(small | flags)), env_cfg=ENV).eval()


def asked(policy: PreTrainedPolicy, batch: dict[str, Any], num_steps: int) -> list[bool]:
    """Return which of so many calls ran the network."""
    policy.reset()
    found = []
    for _ in range(num_steps):
        policy.select_action(dict(batch))
        found.append(last_query() is not None)
        assert last_query() is None
    return found


def test_a_query_is_a_call_that_ran_the_network() -> None:
    policy = make_act()
    time_queries(policy)
    assert asked(policy, ACT_BATCH, 9) == [step % 4 == 0 for step in range(9)]


def test_each_call_is_a_query_where_there_is_no_queue_or_one_of_one_action() -> None:
    ensemble = make_act(n_action_steps=1, temporal_ensemble_coeff=0.01)
    for policy in (ensemble, make_act(n_action_steps=1)):
        time_queries(policy)
        assert asked(policy, ACT_BATCH, 3) == [True] * 3


def test_queues_are_attributes_or_stand_in_a_dict_of_them() -> None:
    policy: Any = SimpleNamespace(
        _action_queue=deque([1, 2]),
        _queues={"action": deque([1]), "image": deque(maxlen=2)},
        other={"a": [1]},
    )
    assert queries._queue_lengths(policy) == {
        ("_action_queue",): 2,
        ("_queues", "action"): 1,
        ("_queues", "image"): 0,
    }


def test_our_policies_tell_passes_and_tokens(policy_type: str) -> None:
    cases = CASES[policy_type]
    policy = cases.make_policy(n_action_steps=2)
    time_queries(policy)
    batch = cases.make_batch(policy, 2)
    assert asked(policy, batch, 4) == [True, False, True, False]
    policy.reset()
    policy.select_action(batch)
    query = last_query()
    assert query is not None and query.seconds > 0 and query.device.startswith("cpu, ")
    assert query.num_parameters == sum(each.numel() for each in policy.parameters())
    assert query.passes is not None and query.passes >= 2
    assert (query.tokens is None) == (policy_type == "fdvla")
    if query.tokens is not None:
        assert query.tokens >= 2  # for two actions


@pytest.mark.parametrize(("solver", "expected"), [("euler", 1 + 3), ("heun", 1 + 5)])
def test_passes_of_fdvla_are_the_prompts_and_the_samplers(
    solver: str, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = CASES["fdvla"].make_policy(solver=solver, sampler="flow", num_inference_steps=3)
    calls = []
    for name in ("read_prefix", "read_segment"):
        usual = getattr(policy.backbone, name)

        def counted(*args: Any, usual: Any = usual, **options: Any) -> Any:
            calls.append(1)
            return usual(*args, **options)

        monkeypatch.setattr(policy.backbone, name, counted)
    policy.select_action(CASES["fdvla"].make_batch(policy, 1))
    assert len(calls) == policy.last_passes == expected


def test_timing_changes_no_action(policy_type: str) -> None:
    cases = CASES[policy_type]
    plain, timed = cases.make_policy(), cases.make_policy()
    time_queries(timed)
    batch = cases.make_batch(plain, 2)
    for _ in range(3):
        assert torch.equal(plain.select_action(batch), timed.select_action(batch))
    assert plain not in queries._CLOCKS


def test_a_policy_that_is_dropped_is_forgotten() -> None:
    policy = make_act()
    time_queries(policy)
    policy.select_action(dict(ACT_BATCH))
    is_there = ref(policy)
    del policy
    gc.collect()
    assert is_there() is None


@pytest.fixture
def slow_act(monkeypatch: pytest.MonkeyPatch) -> Iterator[PreTrainedPolicy]:
    """A query of it takes 30 ms."""
    usual = ACTPolicy.predict_action_chunk

    def slow(self: Any, batch: Any) -> Any:
        time.sleep(0.03)
        return usual(self, batch)

    monkeypatch.setattr(ACTPolicy, "predict_action_chunk", slow)
    yield make_act()


@pytest.mark.parametrize("use_async", [False, True])
def test_a_line_says_what_its_episodes_queries_took(
    use_async: bool, slow_act: PreTrainedPolicy, tmp_path: Path
) -> None:
    results = tmp_path / "results.jsonl"
    config = BombEnvConfig(image_size=32, fps=1, results_path=str(results))
    envs = config.create_envs(2, use_async)["place"][0]
    for seeds in ([0, 1], [2, 3]):
        slow_act.reset()
        envs.reset(seed=seeds)
        is_over = np.zeros(2, dtype=bool)
        while not is_over.all():
            slow_act.select_action(dict(ACT_BATCH))
            _, _, terminated, truncated, _ = envs.step(np.zeros((2, 4), dtype=np.float32))
            is_over |= terminated | truncated
    envs.close()
    records = read_results(results, EpisodeResult)
    assert sorted(record.spec.seed for record in records) == [0, 1, 2, 3]
    for record in records:
        told = record.inference
        assert told is not None
        assert told.num_queries == ceil(record.steps / 4)
        assert told.latency_p95_ms >= told.latency_p50_ms > 30
        assert told.total_s >= 0.03 * told.num_queries
        assert told.passes is None and told.tokens is None
        assert told.peak_memory_bytes is None or told.peak_memory_bytes > 2**20


def test_without_lines_nothing_is_timed() -> None:
    policy = make_act()
    envs = ENV.create_envs(1)["place"][0]
    envs.reset(seed=[0])
    envs.close()
    assert policy not in queries._CLOCKS


def test_a_policy_without_a_network_is_not_timed(tmp_path: Path) -> None:
    policy = make_policy(BombRandomConfig(), env_cfg=ENV)
    time_queries(policy)
    assert policy not in queries._CLOCKS


def test_percentiles_and_means_are_those_of_the_queries() -> None:
    seconds = [0.010, 0.020, 0.030, 0.040, 0.050]
    told = [
        Query(each, passes=number, tokens=None, num_parameters=5, peak_memory_bytes=8, device="cpu")
        for number, each in enumerate(seconds)
    ]
    found = Inference.of(told)
    assert found is not None and Inference.of([]) is None
    assert (found.num_queries, found.passes, found.tokens) == (5, 2.0, None)
    assert (found.latency_p50_ms, found.latency_p95_ms) == pytest.approx((30, 48))
    assert found.total_s == pytest.approx(0.15)


def test_a_line_has_the_smoothness_of_the_executed_actions(tmp_path: Path) -> None:
    env = BombEnv(render_options=SMALL, results_path=str(tmp_path / "r.jsonl"))
    actions = np.random.default_rng(0).uniform(-2, 2, (200, 4))  # some are clipped, which does not count
    env.reset(seed=0)
    for action in actions:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            break
    env.close()
    (record,) = read_results(tmp_path / "r.jsonl", EpisodeResult)
    executed = actions[: record.steps]
    expected = smoothness(executed, np.zeros(len(executed)), exclude=[3])
    assert record.inference is None
    assert (record.action_j2, record.action_j3) == pytest.approx((expected.j2.mean, expected.j3.mean))


def test_an_episode_of_three_actions_has_no_smoothness() -> None:
    env = BombEnv(render_options=SMALL)
    env.reset(seed=0)
    for _ in range(3):
        env.step(np.zeros(4))
    assert env._smoothness() == (None, None)
    env.step(np.zeros(4))
    assert env._smoothness() == (0.0, 0.0)
    env.close()


def told(**other: Any) -> dict[str, Any]:
    """Return the values of a record's field `inference`."""
    found = Inference.of([QUERY, QUERY])
    assert found is not None
    return vars(found) | other


@pytest.mark.parametrize(
    ("planted", "damage"),
    [
        ({"action_j2": -0.1}, "action_j2=-0.1 is impossible"),
        ({"action_j3": "rough"}, 'action_j3="rough" is impossible'),
        ({"inference": 3}, "inference=3 is impossible"),
        ({"inference": {"num_queries": 3}}, "it lacks inference.total_s, inference.latency_p50_ms, "),
        ({"inference": told(num_queries=0)}, "inference.num_queries=0 is impossible"),
        ({"inference": told(latency_p95_ms=-1)}, "inference.latency_p95_ms=-1 is impossible"),
        ({"inference": told(device=None)}, "inference.device=null is impossible"),
    ],
)
def test_what_is_impossible_is_damage(planted: dict[str, Any], damage: str) -> None:
    with pytest.raises(ValueError, match=f"^{damage}"):
        read(values(0) | planted)
    assert read(values(0, inference=told())).inference == Inference(**told())


def test_lines_of_earlier_releases_are_read_and_show_nothing_of_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old = {name: value for name, value in values(0).items() if name not in ("inference", *SMOOTH)}
    path = tmp_path / "old.jsonl"
    path.write_text(json.dumps(old) + "\n")
    assert main(["results", str(path), "--verbose"]) == 0
    out = capsys.readouterr().out
    assert "latency" not in out and "smoothness" not in out and "lack" not in out


def test_results_shows_latency_and_smoothness_where_they_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [values(seed, inference=told(), action_j2=0.5, action_j3=1.0 + seed) for seed in range(3)]
    path = tmp_path / "r.jsonl"
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert main(["results", str(path), "--verbose"]) == 0
    out = capsys.readouterr().out
    assert "latency          500 ms, p95 500 ms (of a query, median over episodes; cpu)" in out
    assert "smoothness       J2 0.5, J3 2 [" in out


def test_what_is_measured_does_not_tell_two_lines_of_an_episode_apart() -> None:
    record = read(values(0, inference=told()))
    assert {"inference"} == MEASURED
    assert different_fields(record, read(values(0, inference=told(total_s=9.0)))) == []
    smooth, rough = (replace(record, action_j2=value) for value in (0.5, 0.6))
    assert different_fields(smooth, rough) == ["action_j2"]
    assert different_fields(record, rough) == []  # of an earlier release, that does not say it


def test_every_field_of_a_query_is_on_the_line() -> None:
    assert {each.name for each in fields(Query)} - {"seconds"} <= {each.name for each in fields(Inference)}


def test_devices_and_batch_sizes_are_not_pooled() -> None:
    rows = []
    for batch_size, device, p50 in ((1, "cpu", 10.0), (1, "cpu", 30.0), (10, "cpu", 50.0), (1, "gpu", 1.0)):
        row = values(len(rows), inference=told(device=device, latency_p50_ms=p50))
        row["policy"]["batch_size"] = batch_size
        rows.append(row)
    found = {
        (each.device, each.batch_size): each for each in efficiencies([*map(read, rows), read(values(9))])
    }
    assert {key: each.latency_p50_ms for key, each in found.items()} == {
        ("cpu", 1): 20.0,
        ("cpu", 10): 50.0,
        ("gpu", 1): 1.0,
    }
    assert found["cpu", 1].actions_per_s == pytest.approx(2 * 20 / 2)  # 20 steps and 1 s each
