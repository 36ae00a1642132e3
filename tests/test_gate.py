import json
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import gate
import numpy as np
import pytest
import torch
from learning_curve import SUCCESS_BGR, count, draw
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.factory import make_pre_post_processors
from lerobot.utils.constants import OBS_STATE
from lerobot_policy_keypoint_probe import KeypointProbeConfig, make_keypoint_probe_pre_post_processors
from lerobot_policy_keypoint_probe.modeling_keypoint_probe import KeypointEncoder, KeypointProbePolicy
from lerobot_policy_keypoint_probe.processor_keypoint_probe import NUM_WORD_IDS, word_ids
from torch import Tensor, nn

from lerobot_bomb.cli import main as lerobot_bomb
from lerobot_bomb.schema import FlagError

CAMERAS = ("observation.images.workspace", "observation.images.wrist")
SIZE = 32  # pixels
STATS = {
    OBS_STATE: {"mean": torch.full((4,), 0.5), "std": torch.full((4,), 2.0)},
    "action": {"mean": torch.full((4,), 0.25), "std": torch.full((4,), 4.0)},
}
INPUTS = {camera: PolicyFeature(type=FeatureType.VISUAL, shape=(3, SIZE, SIZE)) for camera in CAMERAS}
INPUTS |= {
    OBS_STATE: PolicyFeature(type=FeatureType.STATE, shape=(4,)),
    "observation.environment_state": PolicyFeature(type=FeatureType.ENV, shape=(96,)),
}


def make_config(**flags: Any) -> KeypointProbeConfig:
    outputs = {"action": PolicyFeature(type=FeatureType.ACTION, shape=(4,))}
    tiny = {"num_keypoints": 4, "num_channels": 8, "hidden_dim": 16}
    return KeypointProbeConfig(
        **{"device": "cpu", "input_features": dict(INPUTS), "output_features": outputs, **tiny, **flags}
    )


def make_policy() -> KeypointProbePolicy:
    torch.manual_seed(0)
    return KeypointProbePolicy(make_config()).eval()


def raw_batch(*sentences: str) -> dict[str, Any]:
    """What the environment gives, true state included."""
    generator = torch.Generator().manual_seed(1)
    shapes = dict.fromkeys(CAMERAS, (3, SIZE, SIZE))
    shapes |= {OBS_STATE: (4,), "observation.environment_state": (96,)}
    batch = {key: torch.rand(len(sentences), *shape, generator=generator) for key, shape in shapes.items()}
    return {**batch, "task": list(sentences)}


def make_batch(*sentences: str) -> dict[str, Tensor]:
    return make_keypoint_probe_pre_post_processors(make_config(), STATS)[0](raw_batch(*sentences))


# The rung as a whole


@pytest.fixture
def commands(monkeypatch: pytest.MonkeyPatch, stock_cli: Callable[..., None]) -> list[str]:
    """A tiny rung whose commands run in this process; the list of those that ran."""
    ran = []

    def run(command: str, *flags: str) -> None:
        ran.append(command)
        if command == "lerobot-bomb":
            assert lerobot_bomb(flags) == 0
        elif command == "lerobot-train":
            assert "--policy.num_channels=8" in flags
            stock_cli(command, *flags)
        else:
            stock_cli(command, *flags, "--env.fps=2", "--eval.batch_size=1")

    tiny = gate.Rung((), demonstrations=1, steps=2, bar=0.5)
    for name, value in {"run_command": run, "RUNGS": {"tiny": tiny}, "IMAGE_SIZE": SIZE}.items():
        monkeypatch.setattr(gate, name, value)
    for name, value in {"EVAL_EPISODES": 1, "NUM_CHECKPOINTS": 2, "BATCH_SIZE": 2}.items():
        monkeypatch.setattr(gate, name, value)
    cpu_s = iter((100.0, 220.0))  # before and after the training
    monkeypatch.setattr(gate, "_children_cpu_s", lambda: next(cpu_s))
    return ran


def test_a_rung_is_climbed_by_stock_commands_and_goes_on_where_it_stopped(
    commands: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "rung"
    args = Namespace(
        rung="tiny",
        output_dir=folder,
        demonstrations=None,
        steps=None,
        picture=tmp_path / "curve.png",
        json=tmp_path / "gate.json",
        policy_flags=["--policy.num_channels=8"],
    )
    assert gate.climb(args) == 1  # two steps of training teach nothing
    assert commands == ["lerobot-bomb", "lerobot-train", *["lerobot-eval"] * 4]
    figures = json.loads(args.json.read_text())
    assert [(name, point["step"]) for name, point in figures["points"].items()] == [
        ("step 1", 1),
        ("step 2", 2),
        (gate.NO_IMAGES, 2),
        (gate.OTHER_SENTENCE, 2),
    ]
    assert figures["training"]["cpu_minutes"] == 2.0
    assert figures["points"]["step 1"]["cpu_minutes"] == 1.0
    assert all(point["num_episodes"] == 1 for point in figures["points"].values())
    assert "bar 50 %: MISSED" in capsys.readouterr().out

    commands.clear()
    (folder / "eval_000002" / "finished").unlink()
    assert gate.climb(args) == 1
    assert commands == ["lerobot-eval"]
    assert len((folder / "eval_000002" / "results.jsonl").read_text().splitlines()) == 1

    args.steps = 4
    with pytest.raises(RuntimeError, match=r'holds a run of .*"steps": 2.*; name another folder'):
        gate.climb(args)


def test_a_stone_counts_where_the_told_sentence_says() -> None:
    rows = [
        row(None, 1.0, instruction="a"),
        row("wrong_intersection", 45.0, (2, 3), instruction="a"),
        row("dropped", 45.0, (2, 3), instruction="a"),
        row(None, 1.0, (2, 3), instruction="b", target=[2, 3]),
    ]
    told = gate.other_sentences(rows)
    assert told == {"a": "b", "b": "a"}
    assert gate.count_named(rows, told) == 1
    assert gate.count_named(rows, {"a": "a", "b": "b"}) == 2


# The curve


def row(failure: str | None, error_mm: float, nearest: tuple[int, int] = (2, 2), **other: Any) -> dict:
    values = {"is_success": failure is None, "failure": failure, "placement_error_mm": error_mm}
    stage = "placed" if failure is None else "lifted"
    return {**values, "target": [2, 2], "nearest_intersection": list(nearest), "stage": stage, **other}


def test_a_point_counts_grounding_and_precision_apart() -> None:
    rows = [
        row(None, 1.0),
        row(None, 4.0),
        row("imprecise", 15.0),
        row("imprecise", 22.0),
        row("disturbed_others", 2.0, stage="placed"),
        row("wrong_intersection", 45.0, (2, 3)),
        row("dropped", 5.0),
        row("missed_grasp", 170.0, (2, 4), stage="grasped"),
    ]
    point = count(rows, step=100, cpu_minutes=2.5)
    assert (point.step, point.cpu_minutes, point.num_episodes) == (100, 2.5, 8)
    assert (point.num_successes, point.num_lifted, point.num_near) == (2, 7, 4)
    assert (point.num_grounded, point.num_precise) == (5, 3)
    assert point.median_error_mm == 9.5  # of 1, 2, 4, 15, 22 and 45
    assert count([row("dropped", 5.0)], 1, 1.0).median_error_mm is None


def test_the_picture_shows_a_curve_that_rises(tmp_path: Path) -> None:
    points = [
        count([row("imprecise", 12.0)] * 10, 1, 1.0),
        count([row(None, 1.0)] * 10, 2, 2.0),
    ]
    draw(points, "title", tmp_path / "new" / "curve.png")
    picture = cv2.imread(str(tmp_path / "new" / "curve.png"))
    assert picture is not None
    lines, columns = np.nonzero((picture == SUCCESS_BGR).all(axis=2))
    first, last = columns.argmin(), columns.argmax()
    assert columns[last] - columns[first] > picture.shape[1] / 3
    assert lines[first] - lines[last] > picture.shape[0] / 2


# The policy


class FirstChannel(nn.Module):
    def forward(self, image: Tensor) -> Tensor:
        return image[:, :1]


@pytest.mark.parametrize(("column", "line", "x", "y"), [(0, 0, -1, -1), (4, 2, 0, -0.5), (8, 6, 1, 0.5)])
def test_a_keypoint_is_where_the_heat_is(column: int, line: int, x: float, y: float) -> None:
    encoder = KeypointEncoder(num_keypoints=1, num_channels=8, initial_sharpness=30.0)
    encoder.layers = nn.Sequential(FirstChannel())
    image = torch.zeros(1, 3, 9, 9)
    image[:, :, line, column] = 1.0
    torch.testing.assert_close(encoder(image), torch.tensor([[x, y, 3.0]]), atol=1e-4, rtol=0)


def test_keypoints_follow_what_moves() -> None:
    """By a multiple of the strides, far from the edges, the picture and its heat maps move alike."""
    torch.manual_seed(0)
    encoder = KeypointEncoder(num_keypoints=4, num_channels=8, initial_sharpness=5.0)
    image = torch.full((1, 3, 96, 96), 0.5)
    image[:, :, 40:52, 36:48] = torch.rand(3, 12, 12)
    moved = image.roll(shifts=(8, 12), dims=(2, 3))
    before, after = (encoder.layers(2 * picture - 1)[..., 4:-4, 4:-4] for picture in (image, moved))
    assert before.std() > 0.01
    torch.testing.assert_close(after[..., 2:, 3:], before[..., :-2, :-3], atol=1e-4, rtol=1e-4)


class Spy(dict):
    """A batch that notes what is read of it."""

    def __init__(self, batch: dict[str, Tensor]):
        super().__init__(batch)
        self.read = set()

    def __getitem__(self, key: str) -> Tensor:
        self.read.add(key)
        return super().__getitem__(key)


def test_only_images_state_and_sentence_are_read() -> None:
    batch = Spy(make_batch("Set a white stone at (1, 2)."))
    assert "observation.environment_state" in batch
    make_policy().select_action(batch)  # pyright: ignore[reportArgumentType]
    assert batch.read == {*CAMERAS, OBS_STATE, "observation.language.tokens"}


@pytest.mark.parametrize("key", [*CAMERAS, OBS_STATE, "observation.language.tokens"])
def test_each_input_changes_the_action(key: str) -> None:
    policy, batch = make_policy(), make_batch("Set a white stone at (1, 2).")
    changed = {**batch, key: batch[key].flip(-1) if key != "observation.language.tokens" else batch[key] + 1}
    assert not torch.allclose(policy.select_action(changed), policy.select_action(batch), atol=1e-4)


def test_an_action_depends_on_its_own_row_alone() -> None:
    policy, short = make_policy(), "Set a white stone at (1, 2)."
    batch = make_batch(short, "Put a black stone at position (0, 4) on the Go board.")
    alone = {key: value[:1] for key, value in batch.items() if isinstance(value, Tensor)}
    alone["observation.language.tokens"] = torch.tensor([word_ids(short)])  # without what fills up the row
    torch.testing.assert_close(policy.select_action(batch)[:1], policy.select_action(alone))
    assert policy.predict_action_chunk(batch).shape == (2, 1, 4)


def test_the_loss_is_the_mean_absolute_error() -> None:
    policy = make_policy()
    batch = make_batch("Place.", "Put.")
    batch["action"] = policy.select_action(batch) + torch.tensor([[1.0, -1, 1, -1], [3, 0, 0, 1]])
    assert policy.forward(batch)[0].item() == pytest.approx(1.0)
    torch.testing.assert_close(policy.forward(batch, reduction="none")[0], torch.tensor([1.0, 1.0]))


# The sentence


def test_every_sentence_of_the_benchmark_is_another_bag_of_words() -> None:
    from lerobot_env_bomb.task import TEMPLATES

    bags = {
        tuple(sorted(word_ids(template.format(color=color, row=row, column=column))))
        for template in TEMPLATES
        for color in ("black", "white")
        for row in range(5)
        for column in range(5)
    }
    assert len(bags) == 4 * 50
    assert all(0 < word < NUM_WORD_IDS for bag in bags for word in bag)


def test_sentences_become_rows_of_numbers() -> None:
    tokens = make_batch("Place a stone.", "Place a")["observation.language.tokens"]
    assert tokens.tolist() == [word_ids("Place a stone."), [*word_ids("Place a"), 0]]


@pytest.mark.parametrize("task", [None, [], [3]])
def test_without_an_instruction_there_is_no_guess(task: Any) -> None:
    preprocessor = make_keypoint_probe_pre_post_processors(make_config(), STATS)[0]
    with pytest.raises(ValueError, match="needs the instruction under the key 'task'"):
        preprocessor({**raw_batch("Place."), "task": task})


# Checkpoints and flags


def test_a_saved_policy_acts_the_same(tmp_path: Path) -> None:
    policy, sentence = make_policy(), "Set a white stone at (1, 2)."
    policy.save_pretrained(tmp_path)
    for pipeline in make_keypoint_probe_pre_post_processors(policy.config, STATS):
        pipeline.save_pretrained(tmp_path)
    loaded = KeypointProbePolicy.from_pretrained(tmp_path)
    preprocessor, postprocessor = make_pre_post_processors(loaded.config, str(tmp_path))
    batch = preprocessor(raw_batch(sentence))
    torch.testing.assert_close(batch[OBS_STATE], (raw_batch(sentence)[OBS_STATE] - 0.5) / 2.0)
    assert torch.equal(loaded.select_action(batch), policy.select_action(make_batch(sentence)))
    torch.testing.assert_close(postprocessor(torch.ones(1, 4)), torch.full((1, 4), 4.25))


def test_a_checkpoint_without_one_of_the_tensors_is_refused(tmp_path: Path) -> None:
    policy = make_policy()
    tensors = {name: value for name, value in policy.state_dict().items() if name != "words.weight"}
    policy.save_pretrained(tmp_path, state_dict=tensors)
    with pytest.raises(RuntimeError, match=r"Missing key.*words\.weight"):
        KeypointProbePolicy.from_pretrained(tmp_path)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ({"n_obs_steps": 2}, "n_obs_steps=2"),
        ({"num_keypoints": 0}, "num_keypoints=0 must be at least 1"),
        ({"num_channels": 12}, "num_channels=12 must be a multiple of 8"),
        ({"num_state_octaves": -1}, "num_state_octaves=-1"),
    ],
)
def test_impossible_flags_are_refused(flags: dict[str, Any], message: str) -> None:
    with pytest.raises(FlagError, match=message):
        make_config(**flags)


@pytest.mark.parametrize(("left_out", "message"), [(CAMERAS, "at least one camera"), ((OBS_STATE,), "state")])
def test_missing_inputs_are_named(left_out: tuple[str, ...], message: str) -> None:
    inputs = {key: feature for key, feature in INPUTS.items() if key not in left_out}
    with pytest.raises(ValueError, match=message):
        KeypointProbePolicy(make_config(input_features=inputs))
