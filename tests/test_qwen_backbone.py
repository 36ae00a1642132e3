"""Qwen2.5-VL in parts against the stock model, called as its own processor does."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tokenizers import Tokenizer
from torch import Tensor
from transformers import AutoProcessor, AutoTokenizer, Qwen2VLImageProcessor

from lerobot_bomb.vlm.backbone import config_dict
from lerobot_bomb.vlm.prefix import Prefix
from lerobot_bomb.vlm.presets import nano_qwen_config
from lerobot_bomb.vlm.prompt import text_ids
from lerobot_bomb.vlm.qwen import QwenBackbone, QwenPrompt, build_qwen, load_qwen
from lerobot_bomb.vlm.tokenizer import load_tokenizer, nano_tokenizer

SIZE = 112  # 4 x 4 tokens, in 2 x 2 windows of the vision model
TASKS = ("put the black stone on the center", "go")


@pytest.fixture(scope="module")
def nano() -> QwenBackbone:
    torch.manual_seed(0)
    return load_qwen("nano", SIZE).eval()


def prompt_rows(
    backbone: QwenBackbone, tasks: tuple[str, ...] = TASKS, num_images: int = 2
) -> list[list[int]]:
    tokenizer = nano_tokenizer()
    prompt = QwenPrompt.from_tokenizer(tokenizer, "nano")
    image = [prompt.image_start, *backbone.tokens_per_image * [prompt.image], prompt.image_end]
    return [[*prompt.start, *num_images * image, *text_ids(tokenizer, task), *prompt.end] for task in tasks]


def padded(rows: list[list[int]]) -> tuple[Tensor, Tensor]:
    """Ids (B, L) and which are written, padding at the ends."""
    length = max(map(len, rows))
    ids = torch.tensor([row + [0] * (length - len(row)) for row in rows])
    return ids, torch.arange(length) < torch.tensor([[len(row)] for row in rows])


def draw_images(num_images: int, size: int = SIZE) -> np.ndarray:
    """(B, S, S, 3) uint8."""
    return np.random.default_rng(0).integers(0, 256, (num_images, size, size, 3), dtype=np.uint8)


def as_pixels(images: np.ndarray) -> Tensor:
    return torch.from_numpy(images).permute(0, 3, 1, 2) / 255


def embed(backbone: QwenBackbone, ids: Tensor, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Embeddings with the images in place, and which tokens are theirs."""
    is_image = ids == backbone.vlm.config.image_token_id
    features = backbone.embed_images(pixels).flatten(0, 1)
    return backbone.embed_tokens(ids).masked_scatter(is_image[..., None], features), is_image


def read(backbone: QwenBackbone, ids: Tensor, written: Tensor, pixels: Tensor) -> Prefix:
    return backbone.read_prefix(*embed(backbone, ids, pixels), written)


def stock_model(backbone: QwenBackbone) -> Any:
    """Return a model of transformers' own with the same weights."""
    stock = type(backbone.vlm)(backbone.vlm.config)
    stock.load_state_dict(backbone.vlm.state_dict())
    return stock.eval().model


# Prefix


@torch.no_grad()
@pytest.mark.parametrize("size", [56, 112, 140])
def test_a_prefix_is_what_the_stock_model_makes_of_it(size: int) -> None:
    torch.manual_seed(0)
    backbone = load_qwen("nano", size).eval()
    images = draw_images(4, size)
    ids, written = padded(prompt_rows(backbone))
    processed = Qwen2VLImageProcessor(min_pixels=28 * 28)(images=list(images), return_tensors="pt")
    stock = stock_model(backbone)(
        input_ids=ids,
        attention_mask=written.long(),
        mm_token_type_ids=(ids == backbone.vlm.config.image_token_id).int(),
        pixel_values=processed["pixel_values"],
        image_grid_thw=processed["image_grid_thw"],
    )
    prefix = read(backbone, ids, written, as_pixels(images))
    torch.testing.assert_close(prefix.hidden[written], stock.last_hidden_state[written], rtol=0, atol=1e-5)
    after = stock.rope_deltas.flatten() + written.sum(dim=1)
    assert torch.equal(prefix.next_position.flatten(), after)


@torch.no_grad()
def test_padding_changes_nothing_wherever_it_is(nano: QwenBackbone) -> None:
    (row,) = prompt_rows(nano, TASKS[:1])
    pixels = as_pixels(draw_images(2))
    ids = torch.tensor([row])
    whole = read(nano, ids, torch.ones_like(ids, dtype=torch.bool), pixels)
    gap = [0] * 5
    ids = torch.tensor([[*row[:-9], *gap, *row[-9:], *gap]])
    written = torch.tensor([[*[True] * (len(row) - 9), *[False] * 5, *[True] * 9, *[False] * 5]])
    gapped = read(nano, ids, written, pixels)
    torch.testing.assert_close(gapped.hidden[written], whole.hidden[0], rtol=0, atol=1e-5)
    assert torch.equal(gapped.next_position, whole.next_position)


# Segments


@torch.no_grad()
def test_a_segment_goes_on_as_the_stock_model_would(nano: QwenBackbone) -> None:
    """Compare with one causal forward pass over prefix and segment, without a cache."""
    ids, written = padded(prompt_rows(nano, TASKS[:1]))
    embeds, is_image = embed(nano, ids, as_pixels(draw_images(2)))
    segment = torch.randn(1, 6, 128)
    processed = stock_model(nano).get_rope_index(ids, is_image.int(), torch.tensor([[1, 8, 8]] * 2))[0]
    positions = torch.cat([processed, (processed.max() + 1 + torch.arange(6)).expand(3, 1, -1)], dim=2)
    stock = nano.text_model(inputs_embeds=torch.cat([embeds, segment], dim=1), position_ids=positions)
    prefix = nano.read_prefix(embeds, is_image, written)
    causal = torch.ones(1, 6, 6, dtype=torch.bool).tril()
    hidden = nano.read_segment(prefix, segment, causal)
    torch.testing.assert_close(hidden, stock.last_hidden_state[:, -6:], rtol=0, atol=1e-5)


@torch.no_grad()
def test_what_is_kept_of_a_prefix_never_changes(nano: QwenBackbone) -> None:
    ids, written = padded(prompt_rows(nano))
    prefix = read(nano, ids, written, as_pixels(draw_images(4)))
    kept = [tensor.clone() for layer in prefix.layers for tensor in layer]
    everything = torch.ones(2, 3, 3, dtype=torch.bool)
    one, other = (nano.read_segment(prefix, torch.randn(2, 3, 128), everything) for _ in range(2))
    assert not torch.equal(one, other)
    assert all(map(torch.equal, kept, [tensor for layer in prefix.layers for tensor in layer]))


@torch.no_grad()
def test_segments_read_their_own_prefix_without_its_padding(nano: QwenBackbone) -> None:
    ids, written = padded(prompt_rows(nano))
    segment, everything = torch.randn(2, 3, 128), torch.ones(2, 3, 3, dtype=torch.bool)
    pixels = as_pixels(draw_images(4))
    together = nano.read_segment(read(nano, ids, written, pixels), segment, everything)
    for row in range(2):
        short, all_written = padded(prompt_rows(nano, TASKS[row : row + 1]))
        prefix = read(nano, short, all_written, pixels[2 * row : 2 * row + 2])
        alone = nano.read_segment(prefix, segment[row : row + 1], everything[:1])
        torch.testing.assert_close(together[row : row + 1], alone, rtol=0, atol=1e-5)


def test_checkpointed_gradients_are_the_same() -> None:
    gradients = []
    for checkpointed in (False, True):
        torch.manual_seed(0)
        backbone = load_qwen("nano", 56).train()
        if checkpointed:
            backbone.checkpoint_gradients()
        ids, written = padded(prompt_rows(backbone))
        prefix = read(backbone, ids, written, as_pixels(draw_images(4, 56)))
        segment = torch.ones(2, 3, 128)
        backbone.read_segment(
            prefix, segment, torch.ones(2, 3, 3, dtype=torch.bool)
        ).square().sum().backward()
        gradients.append({name: p.grad for name, p in backbone.named_parameters() if p.grad is not None})
    assert gradients[0].keys() == gradients[1].keys() and len(gradients[0]) > 50
    for name, gradient in gradients[0].items():
        torch.testing.assert_close(gradient, gradients[1][name], msg=name)


def test_a_start_that_all_rows_share_is_read_once() -> None:
    found = []
    for num_shared in (0, 5):
        torch.manual_seed(0)
        backbone = load_qwen("nano", 56).train()
        ids, written = padded(prompt_rows(backbone))
        embedded = embed(backbone, ids, as_pixels(draw_images(4, 56)))
        prefix = backbone.read_prefix(*embedded, written, num_shared=num_shared)
        hidden = backbone.read_segment(prefix, torch.ones(2, 3, 128), torch.ones(2, 3, 3, dtype=torch.bool))
        weight_H = torch.linspace(-1, 1, 128)
        (hidden @ weight_H).mean().add((prefix.hidden[:, :-8] @ weight_H).mean()).backward()
        gradients = {name: p.grad for name, p in backbone.named_parameters() if p.grad is not None}
        found.append(([hidden, *prefix.tensors()], gradients))
    (plain, gradients), (shared, of_shared) = found
    for one, other in zip(plain, shared, strict=True):
        torch.testing.assert_close(one, other)
    for name, gradient in gradients.items():
        torch.testing.assert_close(gradient, of_shared[name], rtol=1e-4, atol=1e-5, msg=name)


@torch.no_grad()
def test_copies_of_a_segment_are_read_as_if_alone(nano: QwenBackbone) -> None:
    ids, written = padded(prompt_rows(nano))
    prefix = read(nano, ids, written, as_pixels(draw_images(4)))
    copies = torch.randn(2, 3, 4, 128)  # 3 of each row
    own = torch.ones(2, 4, 4, dtype=torch.bool).tril()
    alone = [nano.read_segment(prefix, copies[:, i], own) for i in range(3)]
    blocks = torch.block_diag(*3 * [own[0].float()]).bool().expand(2, -1, -1)
    together = nano.read_segment(prefix, copies.flatten(1, 2), blocks, num_copies=3)
    torch.testing.assert_close(together, torch.cat(alone, dim=1), rtol=1e-4, atol=1e-5)


# Models


def test_nano_is_small_and_of_the_stock_class(nano: QwenBackbone) -> None:
    assert type(nano.vlm).__name__ == "Qwen2_5_VLForConditionalGeneration"
    assert type(nano.text_model).__name__ == "Qwen2_5_VLTextModel"
    assert sum(parameter.numel() for parameter in nano.parameters()) < 2_000_000


def test_a_backbone_can_be_built_again_from_its_config(nano: QwenBackbone) -> None:
    stored = json.loads(json.dumps(config_dict(nano.vlm)))
    again = build_qwen(stored, SIZE)
    assert config_dict(again.vlm) == stored
    again.load_state_dict(nano.state_dict())


@torch.no_grad()
def test_fresh_nano_features_tell_images_apart() -> None:
    """Even patches vanish, and a small spot is drowned neither by the background nor by training."""
    torch.manual_seed(0)
    backbone = load_qwen("nano", SIZE)
    stem = backbone.vlm.model.visual.patch_embed
    even = torch.ones(1, 3, SIZE, SIZE)
    # a film of equal frames, as even as each
    assert stem(backbone._patches(even)).abs().max() < 1e-4
    spots = even.repeat(4, 1, 1, 1)
    for row, spot in enumerate(spots):
        spot[:, 28 * row : 28 * row + 8, 60:68] = -1
    patches = stem(backbone._patches(spots)).unflatten(0, (4, -1))
    # large beside what training adds to biases in its first hundred steps, about 0.1 at a rate of 1e-3
    assert patches.std(dim=0).amax(dim=(0, 1)).mean() > 1
    features = backbone.embed_images(spots)
    assert features.std(dim=0).mean(dim=1).max() > 0.25 * features.std()


@pytest.mark.parametrize("size", [0, -28, 100, 63])
def test_an_image_size_of_broken_tokens_is_refused(size: int) -> None:
    message = rf"--policy.image_size={size} must be a multiple of 28 pixels: .* 2 x 2 patches of 14 pixels"
    with pytest.raises(ValueError, match=message):
        load_qwen("nano", size)


def test_a_local_folder_is_loaded_with_its_weights(nano: QwenBackbone, tmp_path: Path) -> None:
    nano.vlm.save_pretrained(tmp_path)
    nano_tokenizer().save(str(tmp_path / "tokenizer.json"))
    loaded = load_qwen(str(tmp_path), 56)
    for name, parameter in nano.named_parameters():
        assert torch.equal(parameter, loaded.get_parameter(name)), name
    tokens = [QwenPrompt.from_tokenizer(load_tokenizer(source), source) for source in ("nano", str(tmp_path))]
    assert tokens[0] == tokens[1]


def test_a_folder_without_weights_is_refused(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(json.dumps(nano_qwen_config(nano_tokenizer())))
    with pytest.raises(OSError, match="no weights found"):
        load_qwen(str(tmp_path), 224)


@pytest.mark.parametrize("family", ["qwen2_vl", "gpt2"])
def test_another_kind_of_model_is_refused(family: str, tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(json.dumps({"model_type": family}))
    with pytest.raises(ValueError, match=f"is a '{family}' model; this policy needs a 'qwen2_5_vl' one"):
        load_qwen(str(tmp_path), 224)


def test_a_hub_id_without_network_names_both_ways_out() -> None:
    with pytest.raises(OSError, match=r"=nobody/has-this: .*=nano .* path of a local folder"):
        load_qwen("nobody/has-this", 224)


def test_a_tokenizer_of_another_family_is_refused() -> None:
    text = nano_tokenizer().to_str().replace("<image>", "<photo>")
    with pytest.raises(ValueError, match=r"has no single token for '<\|image_pad\|>' or '<image>'"):
        QwenPrompt.from_tokenizer(Tokenizer.from_str(text), "some/model")


# Published files


@pytest.fixture(scope="module")
def published(shared_data: Path) -> Path:
    return shared_data / "qwen2_5_vl"


def shrunk(published: Path) -> dict[str, Any]:
    config = json.loads((published / "config.json").read_text())
    small = {"num_hidden_layers": 2, "hidden_size": 512, "intermediate_size": 64, "num_attention_heads": 4}
    vision = {"depth": 2, "hidden_size": 64, "intermediate_size": 32, "num_heads": 2, "out_hidden_size": 512}
    config["vision_config"] |= vision | {"fullatt_block_indexes": [1]}
    return config | small | {"num_key_value_heads": 2}


@torch.no_grad()
def test_the_published_processor_and_architecture_shrunk(published: Path) -> None:
    """Chat template, tokens, pixels, positions, and all odd fields of the published config."""
    torch.manual_seed(0)
    backbone = build_qwen(shrunk(published), 224).eval()
    assert {parameter.dtype for parameter in backbone.parameters()} == {torch.float32}
    assert backbone.tokens_per_image == 64
    processor: Any = AutoProcessor.from_pretrained(published)
    tokenizer: Any = AutoTokenizer.from_pretrained(published)
    images = draw_images(2, 224)
    content = [{"type": "image"}, {"type": "image"}, {"type": "text", "text": TASKS[0]}]
    text = processor.apply_chat_template([{"role": "user", "content": content}], add_generation_prompt=True)
    inputs = processor(text=[text], images=list(images), return_tensors="pt")
    stock = stock_model(backbone)(**inputs)

    prompt = QwenPrompt.from_tokenizer(tokenizer.backend_tokenizer, str(published))
    image = [prompt.image_start, *64 * [prompt.image], prompt.image_end]
    task = text_ids(tokenizer.backend_tokenizer, TASKS[0])
    ids = torch.tensor([[*prompt.start, *image, *image, *task, *prompt.end]])
    assert torch.equal(ids, inputs["input_ids"])
    prefix = read(backbone, ids, torch.ones_like(ids, dtype=torch.bool), as_pixels(images))
    torch.testing.assert_close(prefix.hidden, stock.last_hidden_state, rtol=0, atol=1e-5)
