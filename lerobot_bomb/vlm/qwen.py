"""Qwen2.5-VL behind the few operations a policy needs.

A prefix (images and text) is read once; short segments of embeddings then continue it, as often as wanted,
and change nothing that is kept.

Shapes: `B` batch, `L` tokens of a prefix, `T` of a segment, `H` hidden size, `P` tokens of an image, `S` side
of an image in pixels, `V` key-value heads, `E` size of a head.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import torch
from tokenizers import Tokenizer
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint
from transformers import Qwen2_5_VLConfig, Qwen2_5_VLForConditionalGeneration
from transformers.utils.constants import OPENAI_CLIP_MEAN, OPENAI_CLIP_STD

from lerobot_bomb.finite import require_finite_weights
from lerobot_bomb.vlm.attention import causal_mask
from lerobot_bomb.vlm.backbone import (
    CHECKPOINTING,
    Backbone,
    random_model,
    read_vlm_config,
    spread_filters,
    weights_errors,
)
from lerobot_bomb.vlm.images import resize
from lerobot_bomb.vlm.memory import check_memory
from lerobot_bomb.vlm.prefix import KeysValues, Prefix, Reader
from lerobot_bomb.vlm.presets import changed, nano_qwen_config
from lerobot_bomb.vlm.prompt import QWEN_CHAT
from lerobot_bomb.vlm.qwen_vision import embed_patches, read_windows_at_once
from lerobot_bomb.vlm.tokenizer import NANO, load_tokenizer, single_id


@dataclass(frozen=True)
class QwenPrompt:
    """Token ids of all parts of a prompt except the task, in order."""

    start: list[int]
    image_start: int
    image: int
    image_end: int
    end: list[int]

    @classmethod
    def from_tokenizer(cls, tokenizer: Tokenizer, vlm_model_name: str) -> "QwenPrompt":
        """Look up all tokens.

        Raises:
            ValueError: a special token is not exactly one token.
        """
        one = partial(single_id, tokenizer, vlm_model_name, QWEN_CHAT.family)
        return cls(
            start=QWEN_CHAT.opening(tokenizer, vlm_model_name, None),
            image_start=one(*QWEN_CHAT.image_start),
            image=one(*QWEN_CHAT.image),
            image_end=one(*QWEN_CHAT.image_end),
            end=QWEN_CHAT.reply(tokenizer, vlm_model_name),
        )

    def to_dict(self) -> dict[str, int | list[int]]:
        """Return a JSON-ready dict."""
        return asdict(self)


class QwenBackbone(Backbone):
    """A stock ``Qwen2_5_VLForConditionalGeneration``, called in parts.

    Raises:
        ValueError: ``image_size`` does not consist of whole tokens.
    """

    # the family of its base models, as their config.json names it
    family = Qwen2_5_VLConfig.model_type
    text_model_name = "language_model"
    pixel_mean: Tensor  # (3, 1, 1)
    pixel_std: Tensor

    def __init__(self, vlm: Qwen2_5_VLForConditionalGeneration, image_size: int):
        super().__init__(vlm)
        vision_config = self.vlm.config.vision_config
        self._patch, self._merge = vision_config.patch_size, vision_config.spatial_merge_size
        self._frames = vision_config.temporal_patch_size
        self.image_size = image_size  # pixels, square
        self.tokens_per_side = _tokens_per_side(vision_config, image_size)
        self._is_checkpointed = False
        read_windows_at_once(self.vlm.model.visual)
        for name, values in (("pixel_mean", OPENAI_CLIP_MEAN), ("pixel_std", OPENAI_CLIP_STD)):
            self.register_buffer(name, torch.tensor(values)[:, None, None], persistent=False)

    def checkpoint_gradients(self) -> None:
        """Recompute a layer's activations in the backward pass instead of keeping them."""
        self._is_checkpointed = True  # transformers' own kind gives layers no cache
        self.vlm.model.visual.gradient_checkpointing_enable(CHECKPOINTING)

    @property
    def tokens_per_image(self) -> int:
        return self.tokens_per_side**2

    @property
    def layers(self) -> list[nn.Module]:
        """Layers of the text and the vision model."""
        return [*self.text_model.layers, *self.vlm.model.visual.blocks]

    def freeze_vision(self) -> None:
        """Train only the connector and what follows it."""
        self.vlm.model.visual.requires_grad_(False)
        self.vlm.model.visual.merger.requires_grad_(True)

    def pixels(self, images_B3HW: Tensor) -> Tensor:
        """(B, 3, H, W) in [0, 1] -> (B, 3, S, S) in [0, 1]."""
        return resize(images_B3HW, self.image_size)

    def embed_images(self, pixels_B3SS: Tensor) -> Tensor:
        """(B, 3, S, S) in [0, 1] -> (B, P, H)."""
        patches = self._patches((pixels_B3SS - self.pixel_mean) / self.pixel_std)
        side = self.tokens_per_side * self._merge
        return embed_patches(self.vlm.model.visual, patches, len(pixels_B3SS), side)

    def _patches(self, pixels_B3SS: Tensor) -> Tensor:
        """Return a row per patch, as a film of equal frames; a token's patches are consecutive."""
        side = self.tokens_per_side, self._merge, self._patch
        cells = pixels_B3SS.unflatten(3, side).unflatten(2, side)  # B, 3, line, its patch, pixel, column, ...
        cells = cells.permute(0, 2, 5, 3, 6, 1, 4, 7)  # B, line, column, patch, patch, 3, pixel, pixel
        frames = cells[..., None, :, :].expand(*cells.shape[:6], self._frames, *cells.shape[6:])
        return frames.flatten(5).flatten(0, 4)

    def positions(self, column_C: Tensor, image_columns: Tensor) -> Tensor:
        """(C,) columns of a sequence, from 0 -> (3, C) time, line and column of their tokens."""
        is_image_1C = torch.isin(column_C, image_columns.to(column_C.device))[None]
        return self._positions(is_image_1C, torch.ones_like(is_image_1C))[0][:, 0]

    def hidden_states(
        self, embeds_BLH: Tensor, image_columns: Tensor, hidden_BL: Tensor | None = None
    ) -> Tensor:
        """Embeddings (B, L, H), padded on the right -> (B, L, H) states after the last layer.

        ``image_columns``: the images' columns, the same in every row. Attention is causal, so what follows a
        row's end changes nothing before it. ``hidden_BL``: tokens that no other reads.
        """
        column_L = torch.arange(embeds_BLH.shape[1], device=embeds_BLH.device)
        is_image_BL = torch.isin(column_L, image_columns).expand(len(embeds_BLH), -1)
        mask_BL = torch.ones_like(is_image_BL)
        return self.read_prefix(embeds_BLH, is_image_BL, mask_BL, hidden_BL).hidden

    def read_prefix(
        self,
        embeds_BLH: Tensor,
        is_image_BL: Tensor,
        mask_BL: Tensor,
        hidden_BL: Tensor | None = None,
        num_shared: int = 0,
    ) -> Prefix:
        """Read rows from their first column on; ``is_image_BL``: which tokens belong to images.

        ``hidden_BL``: tokens that no other reads. They keep their positions. ``num_shared``: first columns,
        without padding, that are the same in all rows; they are read once.
        """
        positions_3BL, next_B1 = self._positions(is_image_BL, mask_BL)
        attention_mask_BL = mask_BL if hidden_BL is None else mask_BL & ~hidden_BL
        attention_mask_BLL = causal_mask(attention_mask_BL)
        if num_shared == 0 or len(embeds_BLH) == 1:
            hidden_BLH, layers = self._read(embeds_BLH, positions_3BL, attention_mask_BLL)
            return Prefix(hidden_BLH, attention_mask_BL, next_B1, layers)
        first, rest = slice(num_shared), slice(num_shared, None)
        shared = self._read(
            embeds_BLH[:1, first], positions_3BL[:, :1, first], attention_mask_BLL[:1, first, first]
        )
        size = len(embeds_BLH)
        kept = [
            (keys.expand(size, -1, -1, -1), values.expand(size, -1, -1, -1)) for keys, values in shared[1]
        ]
        hidden_BLH, layers = self._read(
            embeds_BLH[:, rest], positions_3BL[:, :, rest], attention_mask_BLL[:, rest], kept
        )
        layers = [
            (torch.cat([ks, keys], dim=2), torch.cat([vs, values], dim=2))
            for (ks, vs), (keys, values) in zip(kept, layers, strict=True)
        ]
        hidden_BLH = torch.cat([shared[0].expand(size, -1, -1), hidden_BLH], dim=1)
        return Prefix(hidden_BLH, attention_mask_BL, next_B1, layers)

    def read_segment(
        self, prefix: Prefix, embeds_BTH: Tensor, attention_mask_BTT: Tensor, num_copies: int = 1
    ) -> Tensor:
        """Return (B, T, H) states after the last layer of tokens that follow a prefix and read all of it.

        ``attention_mask_BTT``: of the segment's tokens among themselves. ``num_copies``: equally long parts
        of the segment, each placed right behind the prefix.
        """
        column_T = torch.arange(embeds_BTH.shape[1], device=embeds_BTH.device)
        positions_BT = prefix.next_position + column_T % (len(column_T) // num_copies)
        prefix_BTL = prefix.attention_mask[:, None].expand(-1, embeds_BTH.shape[1], -1)
        attention_mask_BTX = torch.cat([prefix_BTL, attention_mask_BTT], dim=2)
        return self._read(embeds_BTH, positions_BT.expand(3, -1, -1), attention_mask_BTX, prefix.layers)[0]

    def _read(
        self,
        x_BTH: Tensor,
        positions_3BT: Tensor,
        attention_mask_BTX: Tensor,
        kept: list[KeysValues] | None = None,
    ) -> tuple[Tensor, list[KeysValues]]:
        """Return states after the last layer, and the keys and values of every layer."""
        rotation = self.text_model.rotary_emb(x_BTH, positions_3BT)
        read: Any = _read_layer
        if self._is_checkpointed and torch.is_grad_enabled():
            read = partial(checkpoint, _read_layer, **CHECKPOINTING)
        layers = []
        for i, layer in enumerate(self.text_model.layers):
            x_BTH, new = read(layer, x_BTH, attention_mask_BTX[:, None], rotation, kept and kept[i])
            layers.append(new)
        return self.text_model.norm(x_BTH), layers

    def _positions(self, is_image_BL: Tensor, mask_BL: Tensor) -> tuple[Tensor, Tensor]:
        """Return each token's time, line and column, (3, B, L), and the position of what follows, (B, 1).

        A text token advances all three by one. An image stands still in time; its lines and columns count
        from there, and the next token takes the first position beyond.
        """
        side = self.tokens_per_side
        place_BL = (is_image_BL.cumsum(dim=1) - 1) % side**2
        is_last_BL = place_BL == side**2 - 1
        steps_BL = torch.where(is_image_BL, side * is_last_BL, mask_BL.long())
        ends_BL = steps_BL.cumsum(dim=1)
        starts_BL = ends_BL - steps_BL
        lines_BL, columns_BL = place_BL // side * is_image_BL, place_BL % side * is_image_BL
        return torch.stack([starts_BL, starts_BL + lines_BL, starts_BL + columns_BL]), ends_BL[:, -1:]


def _tokens_per_side(vision_config: Any, image_size: int) -> int:
    """Return how many tokens a line of an image has.

    Raises:
        ValueError: it is not a whole number.
    """
    patch, merge = vision_config.patch_size, vision_config.spatial_merge_size
    if image_size < 1 or image_size % (patch * merge):
        raise ValueError(
            f"--policy.image_size={image_size} must be a multiple of {patch * merge} pixels: "
            f"a token stands for {merge} x {merge} patches of {patch} pixels"
        )
    return image_size // (patch * merge)


def _read_layer(
    layer: nn.Module,
    x_BTH: Tensor,
    attention_mask_B1TX: Tensor,
    rotation: tuple[Tensor, Tensor],
    kept: KeysValues | None,
) -> tuple[Tensor, KeysValues]:
    reader: Any = Reader(kept)
    x_BTH = layer(
        x_BTH, attention_mask=attention_mask_B1TX, position_embeddings=rotation, past_key_values=reader
    )
    return x_BTH, reader.new


def load_qwen(vlm_model_name: str, image_size: int, changes: Mapping[str, Any] | None = None) -> QwenBackbone:
    """Load a backbone with the weights of a Hub id or a local folder, or ``nano`` with random ones.

    ``changes`` alter nano's architecture.

    Raises:
        OSError: config or weights cannot be read; the message names the ways out.
        ValueError: as `check_family`, `changed` and `QwenBackbone`.
    """
    if vlm_model_name == NANO:
        backbone = build_qwen(changed(nano_qwen_config(load_tokenizer(NANO)), changes), image_size)
        spread_filters(backbone.vlm.model.visual.patch_embed.proj.weight)
        return backbone
    config = read_vlm_config(vlm_model_name, QwenBackbone.family)
    _tokens_per_side(config.vision_config, image_size)
    with weights_errors(vlm_model_name):
        vlm = Qwen2_5_VLForConditionalGeneration.from_pretrained(
            vlm_model_name, config=config, dtype=torch.float32, attn_implementation="sdpa"
        )
    require_finite_weights(vlm, f"--policy.vlm_model_name={vlm_model_name}")
    return QwenBackbone(vlm, image_size)


def build_qwen(
    vlm_config: dict[str, Any], image_size: int, dtype: torch.dtype = torch.float32
) -> QwenBackbone:
    """Build the given architecture as `random_model` does."""

    def build() -> Any:
        config = Qwen2_5_VLConfig(**vlm_config)
        return random_model(Qwen2_5_VLForConditionalGeneration, config, dtype, attn_implementation="sdpa")

    check_memory(vlm_config, build, dtype)
    return QwenBackbone(build(), image_size)
