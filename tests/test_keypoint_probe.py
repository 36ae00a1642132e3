from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.factory import make_pre_post_processors
from lerobot.utils.constants import OBS_STATE
from lerobot_policy_keypoint_probe import KeypointProbeConfig, make_keypoint_probe_pre_post_processors
from lerobot_policy_keypoint_probe.modeling_keypoint_probe import KeypointEncoder, KeypointProbePolicy
from lerobot_policy_keypoint_probe.processor_keypoint_probe import NUM_WORD_IDS, word_ids
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from lerobot_bomb.flag_errors import FlagError
from lerobot_bomb.hub.card import Checkpoint

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


def raw_batch(*instructions: str) -> dict[str, Any]:
    """Draw what the environment gives, true state included."""
    generator = torch.Generator().manual_seed(1)
    shapes = dict.fromkeys(CAMERAS, (3, SIZE, SIZE))
    shapes |= {OBS_STATE: (4,), "observation.environment_state": (96,)}
    batch = {key: torch.rand(len(instructions), *shape, generator=generator) for key, shape in shapes.items()}
    return {**batch, "task": list(instructions)}


def make_batch(*instructions: str) -> dict[str, Tensor]:
    return make_keypoint_probe_pre_post_processors(make_config(), STATS)[0](raw_batch(*instructions))


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
    """Check that image and heat maps move alike, by a multiple of the strides, far from the edges."""
    torch.manual_seed(0)
    encoder = KeypointEncoder(num_keypoints=4, num_channels=8, initial_sharpness=5.0)
    image = torch.full((1, 3, 96, 96), 0.5)
    image[:, :, 40:52, 36:48] = torch.rand(3, 12, 12)
    moved = image.roll(shifts=(8, 12), dims=(2, 3))
    before, after = (encoder.layers(2 * image - 1)[..., 4:-4, 4:-4] for image in (image, moved))
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


def test_only_images_state_and_instruction_are_read() -> None:
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


# The instruction


def test_every_instruction_of_the_benchmark_is_another_bag_of_words() -> None:
    from lerobot_bomb.bomb.suites.place import TEMPLATES

    bags = {
        tuple(sorted(word_ids(template.format(color=color, row=row, column=column))))
        for template in TEMPLATES
        for color in ("black", "white")
        for row in range(5)
        for column in range(5)
    }
    assert len(bags) == 4 * 50
    assert all(0 < word < NUM_WORD_IDS for bag in bags for word in bag)


def test_instructions_become_rows_of_numbers() -> None:
    tokens = make_batch("Place a stone.", "Place a")["observation.language.tokens"]
    assert tokens.tolist() == [word_ids("Place a stone."), [*word_ids("Place a"), 0]]


@pytest.mark.parametrize("task", [None, [], [3]])
def test_without_an_instruction_there_is_no_guess(task: Any) -> None:
    preprocessor = make_keypoint_probe_pre_post_processors(make_config(), STATS)[0]
    with pytest.raises(ValueError, match="needs the instruction under the key 'task'"):
        preprocessor({**raw_batch("Place."), "task": task})


# Checkpoints and flags


def test_a_saved_policy_acts_the_same(tmp_path: Path) -> None:
    policy, instruction = make_policy(), "Set a white stone at (1, 2)."
    policy.save_pretrained(tmp_path)
    for pipeline in make_keypoint_probe_pre_post_processors(policy.config, STATS):
        pipeline.save_pretrained(tmp_path)
    loaded = KeypointProbePolicy.from_pretrained(tmp_path)
    preprocessor, postprocessor = make_pre_post_processors(loaded.config, str(tmp_path))
    batch = preprocessor(raw_batch(instruction))
    torch.testing.assert_close(batch[OBS_STATE], (raw_batch(instruction)[OBS_STATE] - 0.5) / 2.0)
    assert torch.equal(loaded.select_action(batch), policy.select_action(make_batch(instruction)))
    torch.testing.assert_close(postprocessor(torch.ones(1, 4)), torch.full((1, 4), 4.25))


def test_a_checkpoint_without_one_of_the_tensors_is_refused(tmp_path: Path) -> None:
    make_policy().save_pretrained(tmp_path)
    path = tmp_path / "model.safetensors"
    save_file({name: value for name, value in load_file(path).items() if name != "words.weight"}, path)
    with pytest.raises(ValueError, match=r"words\.weight"):
        KeypointProbePolicy.from_pretrained(tmp_path)


def test_a_card_of_what_has_no_backbone_names_none() -> None:
    card = Checkpoint(make_config(), KeypointProbePolicy.method, "me/x").card()
    assert "Backbone" not in card.text and "Deep spatial autoencoders" in card.text
    data = card.data.to_dict()
    assert data["license"] == "apache-2.0" and "base_model" not in data


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
