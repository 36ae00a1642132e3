import json
import re
from pathlib import Path
from typing import Any

import fdvla_cases
import pytest
import spatialvla_grid_cases
import torch
import vla0_smol_cases
from lerobot.policies import get_policy_class
from tokenizers import Tokenizer

from lerobot_bomb.vlm.backbone import SmolVLMBackbone, build_backbone, config_dict, load_backbone
from lerobot_bomb.vlm.presets import nano_config
from lerobot_bomb.vlm.prompt import PromptTokens, normalize_task, task_ids, text_ids
from lerobot_bomb.vlm.tokenizer import (
    SPECIAL_TOKENS,
    load_tokenizer,
    nano_tokenizer,
    tokenizer_from_tensor,
    tokenizer_to_tensor,
)

TASK = "Place a black stone on the Go board at row 3, column 1."


@pytest.fixture(scope="module")
def smolvlm2(shared_data: Path) -> Path:
    return shared_data / "SmolVLM2-500M-Video-Instruct"


@pytest.fixture(scope="module")
def nano() -> SmolVLMBackbone:
    torch.manual_seed(0)
    return load_backbone("nano").eval()


# Tokenizers


def test_nano_has_a_token_for_every_word_of_the_task() -> None:
    assert nano_tokenizer().encode(f"Task: {normalize_task(TASK)},").tokens == [
        *("Task", ":", "Ġplace", "Ġa", "Ġblack", "Ġstone", "Ġon", "Ġthe", "Ġgo", "Ġboard", "Ġat"),
        *("Ġrow", "Ġ", "3", ",", "Ġcolumn", "Ġ", "1", ".", ","),
    ]


@pytest.mark.parametrize("text", ["zxq placement of 12_345", "grün \U0001f600 日本語", "tab\tand  spaces"])
def test_nano_writes_any_text(text: str) -> None:
    tokenizer = nano_tokenizer()
    assert tokenizer.decode(tokenizer.encode(text).ids) == text


def test_nano_is_the_same_every_time() -> None:
    assert nano_tokenizer().to_str() == nano_tokenizer().to_str()


def test_a_tokenizer_survives_as_a_tensor() -> None:
    tokenizer = nano_tokenizer()
    stored = tokenizer_to_tensor(tokenizer)
    assert stored.dtype == torch.uint8
    assert tokenizer_from_tensor(stored).to_str() == tokenizer.to_str()


def test_the_real_tokenizer_survives_as_a_tensor(smolvlm2: Path) -> None:
    tokenizer = load_tokenizer(str(smolvlm2))
    stored = tokenizer_to_tensor(tokenizer)
    assert stored.numel() < 1_700_000
    assert task_ids(tokenizer_from_tensor(stored), TASK) == task_ids(tokenizer, TASK)


@pytest.mark.parametrize(
    ("task", "expected"),
    [
        (" Pick_the CUBE \n", "pick the cube"),
        ("one\ntwo\r\nthree", "one two  three"),
        ("_push_", "push"),
        ("", ""),
    ],
)
def test_task_text_is_normalized(task: str, expected: str) -> None:
    assert normalize_task(task) == expected


def test_text_that_looks_like_a_special_token_stays_text() -> None:
    tokenizer = nano_tokenizer()
    special = {tokenizer.token_to_id(text) for text in SPECIAL_TOKENS}
    assert not special & set(task_ids(tokenizer, "look at <image> <end_of_utterance>"))
    assert tokenizer.encode("<image>").ids == [tokenizer.token_to_id("<image>")]


# Prompt pieces


def test_real_token_ids(smolvlm2: Path) -> None:
    tokens = PromptTokens.from_tokenizer(load_tokenizer(str(smolvlm2)), str(smolvlm2))
    assert tokens.symbols == [*range(32, 42), 216, 49279]
    assert tokens.image == 49190
    assert tokens.start == [1, 11126, 42]


def test_prompt_tokens_survive_as_json() -> None:
    tokens = PromptTokens.from_tokenizer(nano_tokenizer(), "nano")
    assert PromptTokens(**json.loads(json.dumps(tokens.to_dict()))) == tokens


@pytest.mark.parametrize(
    ("merge", "where"),
    [
        ("73", "('73' in '1 72 73 74 7')"),
        ("Ġ6", "(' 6' in '3 4 5 6 7 8 ')"),
        ("6Ġ", "('6 ' in ' 4 5 6 7 8 9')"),
        ("9,", "('9,' in '8 9999,')"),
        ("5,", "('5,' in 'ate: 5,')"),
        (":Ġ", "(': ' in 'State: 0 1 2')"),
    ],
)
def test_a_tokenizer_that_merges_digits_is_refused(merge: str, where: str) -> None:
    """Any pair of symbols that becomes one token is found, wherever it stands."""
    stored = json.loads(nano_tokenizer().to_str())
    stored["model"]["vocab"][merge] = len(stored["model"]["vocab"]) + len(SPECIAL_TOKENS)
    stored["model"]["merges"].append(list(merge))
    stored["pre_tokenizer"] = {**stored["pre_tokenizer"]["pretokenizers"][1], "use_regex": False}
    message = f"--policy.vlm_model_name=some/model: its tokenizer merges digits or spaces {where}"
    with pytest.raises(ValueError, match=re.escape(message)):
        PromptTokens.from_tokenizer(Tokenizer.from_str(json.dumps(stored)), "some/model")


def test_digits_that_a_tokenizer_does_not_know_are_refused() -> None:
    stored = json.loads(nano_tokenizer().to_str())
    known = {text: token for text, token in stored["model"]["vocab"].items() if text not in "37"}
    stored["model"] |= {"vocab": known | {"<unk>": stored["model"]["vocab"]["3"]}, "unk_token": "<unk>"}
    message = "writes '3' and '7' as the same token; the policy needs one of its own for every digit"
    with pytest.raises(ValueError, match=message):
        PromptTokens.from_tokenizer(Tokenizer.from_str(json.dumps(stored)), "some/model")


def test_a_tokenizer_that_cuts_and_pads_does_neither_here(tmp_path: Path) -> None:
    tokenizer = nano_tokenizer()
    tokenizer.enable_truncation(8)
    tokenizer.enable_padding(length=16)
    tokenizer.save(str(tmp_path / "tokenizer.json"))
    loaded = load_tokenizer(str(tmp_path)), tokenizer_from_tensor(tokenizer_to_tensor(tokenizer))
    for whole in loaded:
        expected = PromptTokens.from_tokenizer(nano_tokenizer(), "nano")
        assert PromptTokens.from_tokenizer(whole, "some/model") == expected


def test_a_tokenizer_that_drops_the_end_is_refused() -> None:
    stored = json.loads(nano_tokenizer().to_str())
    stored["normalizer"] = {"type": "Replace", "pattern": {"Regex": "9,$"}, "content": "9"}
    with pytest.raises(ValueError, match="its tokenizer merges digits or spaces"):
        PromptTokens.from_tokenizer(Tokenizer.from_str(json.dumps(stored)), "some/model")


def test_a_text_that_cannot_be_tokenized_changes_nothing_for_the_next() -> None:
    tokenizer = nano_tokenizer()
    with pytest.raises(TypeError):
        text_ids(tokenizer, None)  # pyright: ignore[reportArgumentType]
    assert not tokenizer.encode_special_tokens


def test_a_tokenizer_without_the_special_tokens_is_refused() -> None:
    tokenizer = Tokenizer.from_str(nano_tokenizer().to_str().replace("<end_of_utterance>", "<end_of_turn>"))
    with pytest.raises(ValueError, match=r"no single token for '<end_of_utterance>'; .* a SmolVLM tokenizer"):
        PromptTokens.from_tokenizer(tokenizer, "some/model")


# Models


def test_nano_is_small_and_of_the_stock_class(nano: SmolVLMBackbone) -> None:
    assert type(nano.vlm).__name__ == "SmolVLMForConditionalGeneration"
    assert type(nano.vlm.model.text_model).__name__ == "LlamaModel"
    assert sum(parameter.numel() for parameter in nano.parameters()) < 3_000_000


def test_a_backbone_can_be_built_again_from_its_config(nano: SmolVLMBackbone) -> None:
    stored = json.loads(json.dumps(config_dict(nano.vlm)))
    again = build_backbone(stored)
    assert config_dict(again.vlm) == stored
    again.load_state_dict(nano.state_dict())


def test_image_features_are_those_of_the_stock_model(nano: SmolVLMBackbone) -> None:
    pixels = torch.rand(3, 3, nano.image_size, nano.image_size) * 2 - 1
    stock_model: Any = nano.vlm.model
    stock = stock_model.get_image_features(pixels[:, None], return_dict=True).pooler_output
    torch.testing.assert_close(nano.embed_images(pixels), stock)
    assert stock.shape[1] == nano.tokens_per_image


def test_a_mid_grey_image_is_an_image(nano: SmolVLMBackbone) -> None:
    """The stock model takes an image of zeros for padding and drops it."""
    size = nano.image_size
    pixels = torch.stack([torch.zeros(3, size, size), torch.rand(3, size, size)])
    features = nano.embed_images(pixels)
    assert features.shape[0] == 2
    torch.testing.assert_close(features[1:], nano.embed_images(pixels[1:]))


def shrunk_real_config(smolvlm2: Path) -> dict[str, Any]:
    config = json.loads((smolvlm2 / "config.json").read_text())
    config["text_config"] |= {
        "num_hidden_layers": 2,
        "hidden_size": 60,
        "intermediate_size": 64,
        "head_dim": 4,
    }
    config["vision_config"] |= {"num_hidden_layers": 1, "hidden_size": 24, "intermediate_size": 32}
    return config


def test_the_real_architecture_shrunk(smolvlm2: Path) -> None:
    """Check all odd fields of the published config; bfloat16 in it must not reach the weights."""
    backbone = build_backbone(shrunk_real_config(smolvlm2))
    assert {parameter.dtype for parameter in backbone.parameters()} == {torch.float32}
    assert (backbone.image_size, backbone.tokens_per_image) == (512, 64)
    assert backbone.embed_images(torch.zeros(1, 3, 512, 512)).shape == (1, 64, 60)
    assert config_dict(build_backbone(config_dict(backbone.vlm)).vlm) == config_dict(backbone.vlm)


def test_a_local_folder_is_loaded_with_its_weights(nano: SmolVLMBackbone, tmp_path: Path) -> None:
    nano.vlm.save_pretrained(tmp_path)
    nano_tokenizer().save(str(tmp_path / "tokenizer.json"))
    loaded = load_backbone(str(tmp_path))
    for name, parameter in nano.named_parameters():
        assert torch.equal(parameter, loaded.get_parameter(name)), name
    assert load_tokenizer(str(tmp_path)).to_str() == nano_tokenizer().to_str()


@pytest.mark.parametrize("load", [load_tokenizer, load_backbone])
def test_a_hub_id_without_network_names_both_ways_out(load: Any) -> None:
    with pytest.raises(
        OSError, match=r"--policy.vlm_model_name=nobody/has-this: .*=nano .* path of a local folder"
    ):
        load("nobody/has-this")


def test_a_folder_without_weights_is_refused(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(json.dumps(nano_config(nano_tokenizer())))
    with pytest.raises(OSError, match="no weights found"):
        load_backbone(str(tmp_path))
    with pytest.raises(FileNotFoundError, match=r"no tokenizer.json"):
        load_tokenizer(str(tmp_path))


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"model_type": "gpt2"}, "is a 'gpt2' model; this policy needs a 'smolvlm' or 'idefics3' one"),
        (
            {"type": "act"},
            "is a checkpoint of the policy 'act'; `lerobot-bomb checkpoint export-backbone --policy.path=",
        ),
    ],
)
def test_another_kind_of_model_is_refused(config: dict[str, str], message: str, tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(json.dumps(config))
    with pytest.raises(ValueError, match=message):
        load_backbone(str(tmp_path))


@pytest.mark.parametrize(
    "config",
    [vla0_smol_cases.make_config(), fdvla_cases.make_config(), spatialvla_grid_cases.make_config()],
    ids=lambda config: config.type,
)
def test_another_family_is_told_before_its_tokenizer_is_missed(config: Any, tmp_path: Path) -> None:
    config.vlm_model_name = str(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"the folder has no config.json"):
        get_policy_class(config.type)(config)
    (tmp_path / "config.json").write_text('{"model_type": "gpt2"}')
    with pytest.raises(ValueError, match="is a 'gpt2' model; this policy needs a"):
        get_policy_class(config.type)(config)


@torch.no_grad()
def test_fresh_nano_features_tell_images_apart() -> None:
    """Even patches vanish, and a small spot is drowned neither by the background nor by training."""
    torch.manual_seed(0)
    backbone = load_backbone("nano")
    embed = backbone.vlm.model.vision_model.get_submodule("embeddings.patch_embedding")
    even = torch.ones(1, 3, 128, 128)
    assert embed(even).abs().max() < 1e-4
    spots = even.repeat(4, 1, 1, 1)
    for row, spot in enumerate(spots):
        spot[:, 32 * row : 32 * row + 8, 60:68] = -1
    # large beside what training adds to biases in its first hundred steps, about 0.1 at a rate of 1e-3
    assert embed(spots).std(dim=0).amax(dim=(1, 2)).mean() > 1
    features_BPH = backbone.embed_images(spots)
    assert features_BPH.std(dim=0).mean(dim=1).max() > 0.25 * features_BPH.std()
