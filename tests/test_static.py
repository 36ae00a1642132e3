"""Static scenes: boards as they may stand midway, a frame each, and what the expert points at there."""

import json
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fdvla_cases import SMALL as SMALL_FDVLA
from fdvla_cases import make_batch, make_config, make_policy
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata, aggregate_datasets
from lerobot.policies.factory import make_policy as policy_for
from lerobot.policies.factory import make_pre_post_processors
from test_memoryless import TASKS, goals_of_reader, seen
from torch.utils.data import default_collate

from lerobot_bomb.bomb.board import BOARD
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.expert import expert_action
from lerobot_bomb.bomb.observation import PIXELS, RenderOptions
from lerobot_bomb.bomb.pointing import COLUMNS, PLACES_XY_M, Pointing
from lerobot_bomb.bomb.privileged_state import PrivilegedState
from lerobot_bomb.bomb.suite import find_suite
from lerobot_bomb.bomb.suites import SUITES
from lerobot_bomb.commands.main import main
from lerobot_bomb.data import recording
from lerobot_bomb.data.facts import DatasetFacts
from lerobot_bomb.data.record import record
from lerobot_bomb.data.recording import Recording
from lerobot_bomb.data.rollout_pool import RolloutSettings, collect
from lerobot_bomb.envs.rollout import Moment, make_env
from lerobot_bomb.evaluation.trivial import Demonstrations
from lerobot_bomb.policies import pointing
from lerobot_bomb.policies.pointing import places_of
from lerobot_env_bomb.bomb.env import BombEnv
from lerobot_policy_bomb.fdvla import FdvlaConfig
from lerobot_policy_bomb.fdvla.modeling_fdvla import FdvlaPolicy

SMALL = RenderOptions(image_size=32)
IMAGES = Recording("test/episodes", episodes=1, seed=3, task="all", image_size=32, images=True, pointing=True)
LABELS = {f"observation.{name}" for name in COLUMNS}


def static_recording() -> Recording:
    """Return a recording of four episodes of two scenes, of as many suites."""
    return replace(IMAGES, repo_id="test/static", static=8)


@pytest.fixture(autouse=True)
def few_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording, "SCENES", 2)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Scenes of all suites, and a demonstration with the same columns."""
    folder = tmp_path_factory.mktemp("recorded")
    roots = {"scenes": folder / "scenes", "episodes": folder / "episodes"}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recording, "SCENES", 2)
        record(static_recording(), roots["scenes"])
    record(IMAGES, roots["episodes"])
    return roots


def scenes(suite: str, task_id: int | None, seeds: Iterable[int]) -> Iterator[tuple[BombEnv, dict[str, Any]]]:
    env: Any = make_env(EpisodeSpec(0, suite, task_id=task_id), SMALL).unwrapped
    for seed in seeds:
        observation, _ = env.show_static(seed)
        yield env, observation
    env.close()


@pytest.mark.parametrize("suite", SUITES)
def test_a_reader_of_scene_and_sentence_acts_as_its_label(suite: str) -> None:
    rng = np.random.default_rng(0)
    numbers_held, numbers_made = set(), set()
    for number, task_id in enumerate(task_id for task_suite, task_id in TASKS if task_suite == suite):
        for env, observation in scenes(suite, task_id, range(8 * number, 8 * number + 4)):
            moment = Moment(0, env.task_description, observation, {}, None)
            episode = find_suite(suite).sample(replace(env._spec, seed=env._run.episode.spec.seed))
            view = seen(moment, dict(episode.pattern), rng)
            read = expert_action(replace(view.state, goals=goals_of_reader(view)))
            np.testing.assert_allclose(read, expert_action(moment.state), atol=0.02, err_msg=view.text)
            numbers_held.add(view.held is not None)
            numbers_made.add(env._run.judge.num_made)
    assert numbers_held == {True, False}
    assert (len(numbers_made) > 1) == (suite in ("goal", "long"))


def test_a_scene_is_the_same_for_the_same_seed_and_another_for_another() -> None:
    images = [observation[PIXELS]["workspace"] for _, observation in scenes("spatial", None, range(3))]
    again = [observation[PIXELS]["workspace"] for _, observation in scenes("spatial", None, range(3))]
    np.testing.assert_array_equal(images, again)
    assert len({image.tobytes() for image in images}) == 3


def test_the_expert_points_at_the_goal_that_it_acts_for() -> None:
    env: Any = make_env(EpisodeSpec(0, target=(1, 2)), SMALL).unwrapped
    observation, _ = env.reset(seed=3)
    state = PrivilegedState.from_vector(observation["environment_state"])
    pointing = Pointing.of(state, np.random.default_rng(0))
    np.testing.assert_allclose(pointing.place_xy, BOARD.intersection_xy(1, 2), atol=1e-6)
    np.testing.assert_allclose(pointing.stone_xy, state.stone_xyz[0, :2])
    assert pointing.held == 0
    carried = replace(
        state,
        gripper_xyz=np.array([0.1, 0.0, 0.05]),
        finger_opening=0.0248,
        stone_xyz=np.vstack([[0.1, 0.0, 0.052], state.stone_xyz[1:]]),
    )
    pointing = Pointing.of(carried, np.random.default_rng(0))
    assert pointing.held == 1
    for xy, action in zip(pointing.other_places_xy, pointing.other_actions, strict=True):
        assert min(np.hypot(*(xy - np.array(place))) for place in PLACES_XY_M) < 1e-9
        way = xy - carried.gripper_xyz[:2]
        assert action[:2] @ way > 0.9 * np.linalg.norm(action[:2]) * np.linalg.norm(way)
    env.close()


def test_a_recording_has_a_frame_a_scene_and_its_labels(recorded: dict[str, Path]) -> None:
    dataset = LeRobotDataset("test/static", root=recorded["scenes"])
    assert (dataset.num_episodes, len(dataset)) == (4, 8)
    assert set(dataset.features) > LABELS
    of_first = static_recording()
    spec = next(of_first.specs(0))
    env = make_env(spec, SMALL)
    rollout = collect(env, spec, RolloutSettings(SMALL, static=2, pointing=True))
    env.close()
    for step in (0, 1):
        frame: Any = dataset[step]
        np.testing.assert_array_equal(frame["action"], rollout.actions[step])
        np.testing.assert_array_equal(frame["observation.state"], rollout.states[step])
        assert frame["task"] == rollout.instructions[step] and frame["next.done"]
        for name in COLUMNS:
            np.testing.assert_array_equal(frame[f"observation.{name}"], rollout.pointing[name][step])
    assert rollout.instructions[0] != rollout.instructions[1]
    facts = DatasetFacts.read(recorded["scenes"])
    assert facts.recording["static"] == 8 and facts.environment is not None
    assert (facts.environment.task, facts.environment.task_version) == ("all", "1.1")


def test_only_the_last_frame_of_a_demonstration_is_done(recorded: dict[str, Path]) -> None:
    dataset: Any = LeRobotDataset("test/episodes", root=recorded["episodes"])
    done = [bool(dataset[i]["next.done"]) for i in range(len(dataset))]
    assert done == [False] * (len(done) - 1) + [True]


def test_of_a_scene_a_chunk_is_its_first_action(recorded: dict[str, Path]) -> None:
    policy = make_policy(chunk_size=4)
    batch = make_batch(policy, 3) | {"next.done": torch.tensor([[True], [False], [True]])}
    assert policy._loss_mask(batch).tolist() == [[True] + 3 * [False], 4 * [True], [True] + 3 * [False]]
    batch["action_is_pad"] = torch.tensor(3 * [[False, False, True, True]])
    assert policy._loss_mask(batch).sum(dim=1).tolist() == [1, 2, 1]
    policy.config.loss_on_padded_actions = True  # padding repeats the last action, which is another scene's
    assert policy._loss_mask(batch).sum(dim=1).tolist() == [1, 4, 1]
    batch["action_is_pad"][:, 1:] = True  # the last scene
    assert policy._loss_mask(batch).all()


def test_scenes_are_no_episodes(recorded: dict[str, Path], capsys: pytest.CaptureFixture[str]) -> None:
    scenes = ["--dataset.repo_id=test/static", f"--dataset.root={recorded['scenes']}"]
    assert main(["results", "smoothness", *scenes]) == 1
    told = "episode 0 of test/static holds static scenes, which do not follow each other"
    assert told in capsys.readouterr().err
    meta = LeRobotDatasetMetadata("test/static", root=recorded["scenes"])
    scenes_of_two = Demonstrations.read(meta, [0, 1], [])
    assert scenes_of_two.run_index.tolist() == list(range(len(scenes_of_two.actions)))
    config = FdvlaConfig(
        **SMALL_FDVLA | {"chunk_size": 2, "n_action_steps": 2, "relative_actions": True}, push_to_hub=False
    )
    with pytest.raises(ValueError, match=told):
        policy_for(config, ds_meta=meta)
    assert (
        main(["results", "smoothness", "--dataset.repo_id=t/e", f"--dataset.root={recorded['episodes']}"])
        == 0
    )


def test_no_chunk_is_longer_than_every_episode(recorded: dict[str, Path]) -> None:
    meta = LeRobotDatasetMetadata("test/static", root=recorded["scenes"])
    options: dict[str, Any] = SMALL_FDVLA | {"chunk_size": 9, "n_action_steps": 1}
    config = FdvlaConfig(**options, push_to_hub=False)
    with pytest.raises(ValueError, match=r"--policy.chunk_size=9: .* has 2 frames; give at most 2"):
        policy_for(config, ds_meta=meta)


def test_seeds_of_scenes_do_not_repeat() -> None:
    of_two = static_recording()
    seeds = [spec.seed for spec, _ in zip(of_two.specs(0), range(10), strict=False)]
    assert seeds == 5 * [3] + 5 * [5]
    assert of_two.episodes == 4 and of_two.pointing


def test_a_label_is_no_input_of_a_policy_that_is_trained_on_it(recorded: dict[str, Path]) -> None:
    meta = LeRobotDataset("test/static", root=recorded["scenes"]).meta
    options: dict[str, Any] = SMALL_FDVLA | {"chunk_size": 1, "n_action_steps": 1}
    policy = policy_for(FdvlaConfig(**options, push_to_hub=False), ds_meta=meta)
    assert not LABELS & set(policy.config.input_features or {})
    assert "observation.state" in (policy.config.input_features or {})


def pointing_policy(meta: LeRobotDatasetMetadata) -> FdvlaPolicy:
    options = {"pointing": True, "chunk_size": 1, "n_action_steps": 1}
    policy = policy_for(FdvlaConfig(**SMALL_FDVLA | options, push_to_hub=False), ds_meta=meta)
    assert isinstance(policy, FdvlaPolicy)
    return policy


def test_a_policy_points_as_recorded(recorded: dict[str, Path], tmp_path: Path) -> None:
    dataset: Any = LeRobotDataset("test/static", root=recorded["scenes"])
    policy = pointing_policy(dataset.meta)
    assert policy.pointer is not None
    for place in policy.config.pointing_places or []:
        assert min(np.hypot(*(np.array(place) - np.array(xy))) for xy in PLACES_XY_M) < 1e-5
    raw: Any = default_collate([dataset[i] for i in range(len(dataset))])
    preprocessor, _ = make_pre_post_processors(policy.config, dataset_stats=dataset.meta.stats)
    batch = preprocessor(raw)
    torch.testing.assert_close(batch["observation.pointing.place"], raw["observation.pointing.place"])
    pointed = policy._point(policy._read(batch), batch["observation.state"])
    torch.testing.assert_close(pointed.gripper, raw["observation.state"][:, :3], atol=1e-5, rtol=0)
    labels = policy.pointer.labels(batch, 1.0, "fdvla", torch.Generator().manual_seed(0))
    torch.testing.assert_close(
        policy.pointer.places[labels.place], raw["observation.pointing.place"], atol=1e-5, rtol=0
    )
    loss, metrics = policy.train()(batch)
    assert torch.isfinite(loss) and metrics["place_loss"] > 0 and metrics["board_loss"] > 0
    policy.save_pretrained(tmp_path)
    again = FdvlaPolicy.from_pretrained(tmp_path).eval()
    answers = [each.predict_action_chunk(batch) for each in (policy.eval(), again)]
    torch.testing.assert_close(*answers, rtol=0, atol=0)


def test_a_dataset_that_does_not_point_is_refused(recorded: dict[str, Path], tmp_path: Path) -> None:
    features = LeRobotDatasetMetadata("test/static", root=recorded["scenes"]).features
    plain = {key: feature for key, feature in features.items() if key not in LABELS}
    meta = LeRobotDatasetMetadata.create("test/plain", fps=10, features=plain, root=tmp_path / "plain")
    with pytest.raises(ValueError, match=r"observation\.pointing\.place, .* which test/plain lacks"):
        make_config(pointing=True).take_places(meta)


def test_a_checkpoint_points_at_its_own_places_only(
    recorded: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    meta = LeRobotDatasetMetadata("test/static", root=recorded["scenes"])
    found = places_of(meta, None)
    assert places_of(meta, [*found, [0.5, 0.5]]) == [*found, [0.5, 0.5]]
    with pytest.raises(ValueError, match=r"test/static points at .*, which is no place of this checkpoint"):
        places_of(meta, found[1:])
    monkeypatch.setattr(pointing, "RARE", 0.99)  # of all that this dataset points at
    assert places_of(meta, found[1:]) == found[1:]


def test_lerobot_merges_scenes_with_demonstrations_and_the_suite_stays_known(
    recorded: dict[str, Path], tmp_path: Path
) -> None:
    roots = [recorded["episodes"], recorded["scenes"]]
    aggregate_datasets(["test/a", "test/b"], "test/merged", roots=roots, aggr_root=tmp_path / "merged")
    merged = LeRobotDataset("test/merged", root=tmp_path / "merged")
    assert merged.num_episodes == 5 and set(merged.features) > LABELS
    environment = DatasetFacts.read(tmp_path / "merged").environment
    assert environment is not None and environment.task == "goal+long+object+place"  # none is of spatial


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("--static=0", "--static=0 records nothing"),
        ("--static=-2", "--static=-2 must be in 1..2 or a multiple of 2"),
        ("--static=3", "--static=3 must be in 1..2 or a multiple of 2"),
        ("--episodes=0", "--episodes=0 must be at least 1"),
        ("--static=2 --noise=0.05", "--noise=0.05: static scenes are no episodes"),
        ("--static=2 --task=all --task_ids=[1]", "--env.task_ids=[1] are numbers in a suite"),
        ("--static=2 --task=every", "--env.task='every' is unknown; choose one of: goal, long"),
    ],
)
def test_wrong_flags_are_named(flags: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["record", "--repo_id=test/x", *flags.split()]) != 0
    assert message in capsys.readouterr().err


def test_scenes_or_episodes(capsys: pytest.CaptureFixture[str]) -> None:
    for flags in ([], ["--static=2", "--episodes=2"]):
        with pytest.raises(SystemExit):
            main(["record", "--repo_id=test/x", *flags])
        assert "--static" in capsys.readouterr().err


def test_the_suite_of_each_episode_is_in_its_row(recorded: dict[str, Path]) -> None:
    import pyarrow.parquet as pq

    rows = pq.read_table(recorded["scenes"] / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [json.loads(row["bomb/spec"])["suite"] for row in rows] == list(SUITES)[:4]
    versions = [row["bomb/protocol_version"] for row in rows]
    assert versions == ["1.1", "1.1", "1.1", "1.0"]  # goal, long, object, place
