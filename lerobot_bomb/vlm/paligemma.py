"""PaliGemma 2, reduced to the few operations that a policy needs.

Shapes: `B` batch, `L` tokens, `H` hidden size of the text model, `E` of the vision model, `V` vocabulary, `P`
tokens of an image.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import torch
from tokenizers import Tokenizer
from torch import Tensor
from transformers import PaliGemmaConfig, PaliGemmaForConditionalGeneration

from lerobot_bomb.actions.text import SYMBOL_TEXTS
from lerobot_bomb.finite import require_finite_weights
from lerobot_bomb.vlm.attention import attention_bias
from lerobot_bomb.vlm.backbone import Backbone, random_model, read_vlm_config, spread_images, weights_errors
from lerobot_bomb.vlm.memory import check_memory
from lerobot_bomb.vlm.presets import changed, nano_paligemma_config
from lerobot_bomb.vlm.tokenizer import IMAGE_TOKEN, NANO, load_tokenizer, single_id, token_ids


@dataclass(frozen=True)
class PaliGemmaPrompt:
    """Token ids of everything in a prompt but the task: IMG..., start, task, state, its numbers, task_end."""

    image: int
    start: list[int]
    state_start: list[int]
    symbols: list[int]  # digits 0-9, space
    task_end: list[int]

    @classmethod
    def from_tokenizer(cls, tokenizer: Tokenizer, vlm_model_name: str) -> "PaliGemmaPrompt":
        """Look up all tokens.

        Raises:
            ValueError: a digit, the space or a special token is not exactly one token.
        """
        several = partial(token_ids, tokenizer)
        one = partial(single_id, tokenizer, vlm_model_name, "PaliGemma")
        # the second of each pair is the nano tokenizer's
        return cls(
            image=one(IMAGE_TOKEN),
            start=[one("<bos>", "<|im_start|>")],
            state_start=several(" state:"),
            symbols=[one(text) for text in SYMBOL_TEXTS],
            task_end=several("\n"),
        )

    def to_dict(self) -> dict[str, int | list[int]]:
        """Return a JSON-ready dict."""
        return asdict(self)


class PaliGemmaBackbone(Backbone):
    """A stock ``PaliGemmaForConditionalGeneration`` with Gemma 2, called in parts.

    Gemma 2 multiplies embeddings by sqrt(H); transformers 5 does so inside ``embed_tokens``, and image
    features are not divided by it. Any other input of the text model must have that scale.
    """

    # the family of its base models, as their config.json names it
    family = PaliGemmaConfig.model_type
    text_model_name = "language_model"

    def __init__(self, vlm: PaliGemmaForConditionalGeneration):
        super().__init__(vlm)
        text_config, vision_config = self.text_config, self.vlm.config.vision_config
        self.image_size: int = vision_config.image_size  # pixels, square
        self.patches_per_side = vision_config.image_size // vision_config.patch_size
        self.vision_hidden_size: int = vision_config.hidden_size
        self.embed_scale = text_config.hidden_size**0.5
        self.softcap: float | None = text_config.final_logit_softcapping

    @property
    def tokens_per_image(self) -> int:
        return self.patches_per_side**2

    @property
    def has_tied_head(self) -> bool:
        """True if input and output embeddings are one table."""
        return self.vlm.lm_head.weight is self.vlm.get_input_embeddings().weight

    def encode_pixels(self, pixels_B3SS: Tensor) -> Tensor:
        """(B, 3, S, S) in [-1, 1] -> (B, P, E) features of the vision model."""
        return self.vlm.model.vision_tower(pixels_B3SS).last_hidden_state

    def project(self, features_BPE: Tensor) -> Tensor:
        """(B, P, E) -> (B, P, H)."""
        return self.vlm.model.multi_modal_projector(features_BPE)

    @staticmethod
    def positions(columns: Tensor) -> Tensor:
        """Places in a sequence, from 0 -> positions as PaliGemma counts them, from 1."""
        return columns + 1

    def hidden_states(self, embeds_BLH: Tensor, columns_BL: Tensor, attention_mask_BLL: Tensor) -> Tensor:
        """(B, L, H) states after the last layer.

        ``columns_BL``: places in a sequence, from 0; ``attention_mask_BLL``: bool, a row per attending token.
        """
        mask = attention_bias(attention_mask_BLL, embeds_BLH.dtype)
        return self.text_model(
            inputs_embeds=embeds_BLH,
            attention_mask={"full_attention": mask, "sliding_attention": mask},
            position_ids=self.positions(columns_BL),
            use_cache=False,
        ).last_hidden_state

    def cap(self, logits: Tensor) -> Tensor:
        """Apply Gemma 2's soft limit of logits, which keeps their order."""
        return logits if self.softcap is None else self.softcap * torch.tanh(logits / self.softcap)


def load_paligemma(vlm_model_name: str, changes: Mapping[str, Any] | None = None) -> PaliGemmaBackbone:
    """Load a backbone with the weights of a Hub id or a local folder, or ``nano`` with random ones.

    ``changes`` alter nano's architecture.

    Raises:
        OSError: config or weights cannot be read; the message names the ways out.
        ValueError: the model is not a PaliGemma 2, or as `check_family` and `changed`.
    """
    if vlm_model_name == NANO:
        backbone = build_paligemma(changed(nano_paligemma_config(load_tokenizer(NANO)), changes))
        spread_images(backbone.vlm.model.vision_tower)
        return backbone
    config = read_vlm_config(vlm_model_name, PaliGemmaBackbone.family)
    if config.text_config.model_type != "gemma2":
        raise ValueError(
            f"--policy.vlm_model_name={vlm_model_name} has {config.text_config.model_type!r} as its text "
            f"model; this policy needs 'gemma2' (PaliGemma 2)"
        )
    with weights_errors(vlm_model_name):
        vlm = PaliGemmaForConditionalGeneration.from_pretrained(
            vlm_model_name,
            config=config,
            dtype=torch.float32,
            attn_implementation=_attention(config.text_config),
        )
    require_finite_weights(vlm, f"--policy.vlm_model_name={vlm_model_name}")
    return PaliGemmaBackbone(vlm)


def build_paligemma(vlm_config: dict[str, Any], dtype: torch.dtype = torch.float32) -> PaliGemmaBackbone:
    """Build the given architecture as `random_model` does."""

    def build() -> Any:
        config = PaliGemmaConfig(**vlm_config)
        attention = _attention(config.text_config)
        return random_model(PaliGemmaForConditionalGeneration, config, dtype, attn_implementation=attention)

    check_memory(vlm_config, build, dtype)
    vlm = build()
    words = vlm.get_input_embeddings()
    words.embed_scale.fill_(words.scalar_embed_scale)  # was made in ``dtype``
    return PaliGemmaBackbone(vlm)


def _attention(text_config: Any) -> dict[str, str]:
    """Return the attention of each model; transformers' ``sdpa`` leaves out the soft limit of logits."""
    kind = "sdpa" if text_config.attn_logit_softcapping is None else "eager"
    return {"text_config": kind, "vision_config": "sdpa"}
