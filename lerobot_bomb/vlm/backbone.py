"""SmolVLM of both generations, reduced to the operations that a policy needs; base of other families.

Shapes: `B` batch, `L` tokens, `H` hidden size of the text model, `V` vocabulary, `P` tokens of an image.
"""

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn.functional import linear
from transformers import (
    AutoConfig,
    Idefics3Config,
    Idefics3ForConditionalGeneration,
    PreTrainedModel,
    SmolVLMConfig,
    SmolVLMForConditionalGeneration,
)

from lerobot_bomb.files import read_json
from lerobot_bomb.finite import require_finite_weights
from lerobot_bomb.vlm.attention import Float32Attention, attention_bias, causal_mask
from lerobot_bomb.vlm.images import resized_pixels
from lerobot_bomb.vlm.memory import check_memory
from lerobot_bomb.vlm.presets import INITIALIZER_RANGE, changed, nano_config
from lerobot_bomb.vlm.tokenizer import NANO, hub_file, load_tokenizer


def as_it_was_computed() -> tuple[AbstractContextManager, AbstractContextManager]:
    """Return contexts of a checkpointed layer and of its recomputation, with attention in the same precision.

    Torch itself restores autocast and random state.
    """
    is_float32 = torch.is_autocast_enabled("cpu")
    return nullcontext(), Float32Attention() if is_float32 else nullcontext()


# modules that autocast casts to bfloat16
PRODUCTS = (nn.Linear, nn.Conv2d, nn.Conv3d)
# options of `torch.utils.checkpoint`
CHECKPOINTING: dict[str, Any] = {"use_reentrant": False, "context_fn": as_it_was_computed}


class Backbone(nn.Module):
    """A stock vision-language model, called in parts; base of all families."""

    # the text model's name among the parts of ``vlm.model``
    text_model_name: ClassVar[str]

    def __init__(self, vlm: PreTrainedModel):
        super().__init__()
        self.vlm: Any = vlm
        self.text_config: Any = vlm.config.text_config

    @property
    def text_model(self) -> Any:
        return self.vlm.model.get_submodule(self.text_model_name)

    def checkpoint_gradients(self) -> None:
        """Recompute a layer's activations in the backward pass instead of keeping them."""
        self.vlm.gradient_checkpointing_enable(CHECKPOINTING)

    def embed_tokens(self, tokens_BL: Tensor) -> Tensor:
        """(B, L) token ids -> (B, L, H)."""
        return self.vlm.get_input_embeddings()(tokens_BL)

    def head(self, token_ids: Tensor) -> Callable[[Tensor], Tensor]:
        """Return the output head of a few tokens, in float32: (..., H) -> (..., len(token_ids)).

        In bfloat16 several of ten digits are often equally likely, and argmax takes the lowest.
        """
        head = self.vlm.lm_head
        if type(head) is not nn.Linear:  # such as one with an adapter
            return lambda hidden: in_float32(head, hidden)[..., token_ids]
        return partial(exact_linear, weight=head.weight[token_ids])

    def logits(self, hidden_BLH: Tensor) -> Tensor:
        """(..., H) -> (..., V)."""
        return self.vlm.lm_head(hidden_BLH)


class SmolVLMBackbone(Backbone):
    """A stock SmolVLM; the first generation's class is Idefics 3's, made of the same parts."""

    text_model_name = "text_model"
    # config and model of each generation, as their config.json names it
    classes: ClassVar[dict[str, tuple[Any, Any]]] = {
        SmolVLMConfig.model_type: (SmolVLMConfig, SmolVLMForConditionalGeneration),
        Idefics3Config.model_type: (Idefics3Config, Idefics3ForConditionalGeneration),
    }

    def __init__(self, vlm: PreTrainedModel):
        super().__init__(vlm)
        self.image_size: int = self.vlm.config.vision_config.image_size  # pixels, square
        self.tokens_per_image: int = self.vlm.model.image_seq_len

    @property
    def layers(self) -> list[nn.Module]:
        """Layers of the text and the vision model."""
        return [*self.text_model.layers, *self.vlm.model.vision_model.encoder.layers]

    def freeze_vision(self) -> None:
        """Train only the connector and what follows it."""
        self.vlm.model.vision_model.requires_grad_(False)

    def pixels(self, images_B3HW: Tensor) -> Tensor:
        """(B, 3, H, W) in [0, 1] -> (B, 3, S, S) in [-1, 1]."""
        return resized_pixels(images_B3HW, self.image_size)

    def embed_images(self, pixels_B3SS: Tensor) -> Tensor:
        """(B, 3, S, S) in [-1, 1] -> (B, P, H).

        Vision model and connector are called directly: ``get_image_features`` takes an image of exactly
        zeros, that is uniform mid-grey, for padding and drops it.
        """
        model = self.vlm.model
        return model.connector(model.vision_model(pixels_B3SS).last_hidden_state)

    def positions(self, column_C: Tensor, image_columns: Tensor) -> Tensor:
        """(C,) columns of a sequence, from 0 -> (C,) positions, whichever of them hold images."""
        return column_C

    def hidden_states(
        self, embeds_BLH: Tensor, image_columns: Tensor | None = None, hidden_BL: Tensor | None = None
    ) -> Tensor:
        """Embeddings (B, L, H), padded on the right -> (B, L, H) states after the last layer.

        Attention is causal, so what follows a row's end changes nothing before it. ``hidden_BL``: tokens that
        no other reads.
        """
        bias = None if hidden_BL is None else attention_bias(causal_mask(~hidden_BL), embeds_BLH.dtype)
        return self.text_model(
            inputs_embeds=embeds_BLH, attention_mask=bias, use_cache=False
        ).last_hidden_state


def in_float32[T](module: Callable[[Tensor], T], hidden: Tensor) -> T:
    """Run a module of float32 weights on (..., H), whatever autocast says."""
    # entering the context takes longer than a small product
    if not torch.is_autocast_enabled(hidden.device.type):
        return module(hidden.float())
    with torch.autocast(hidden.device.type, enabled=False):
        return module(hidden.float())


def exact_linear(hidden: Tensor, weight: Tensor) -> Tensor:
    """(..., H), (O, H) -> (..., O) float32."""
    return in_float32(partial(linear, weight=weight.float()), hidden)


def load_backbone(
    vlm_model_name: str, changes: Mapping[str, Any] | None = None, image_size: int | None = None
) -> SmolVLMBackbone:
    """Load a backbone with the weights of a Hub id or a local folder, or ``nano`` with random ones.

    ``changes`` alter nano's architecture; the model must have ``image_size``, if any.

    Raises:
        OSError: config or weights cannot be read; the message names the ways out.
        ValueError: as `check_family` and `changed`, weights are not finite, or images have another size.
    """
    if vlm_model_name == NANO:
        vlm_config = changed(nano_config(load_tokenizer(NANO)), changes)
        backbone = build_backbone(vlm_config, image_size)
        spread_images(backbone.vlm.model.vision_model)
        return backbone
    config = read_vlm_config(vlm_model_name, *SmolVLMBackbone.classes)
    _check_image_size(config.vision_config.image_size, image_size)
    _, model_class = SmolVLMBackbone.classes[config.model_type]
    with weights_errors(vlm_model_name):
        vlm = model_class.from_pretrained(vlm_model_name, config=config, dtype=torch.float32)
    require_finite_weights(vlm, f"--policy.vlm_model_name={vlm_model_name}")
    return SmolVLMBackbone(vlm)


def _check_image_size(own: int, asked: int | None) -> None:
    if asked not in (None, own):
        raise ValueError(
            f"--policy.image_size={asked}: this SmolVLM has learned positions for images of {own} pixels and "
            f"takes no others; leave the flag out"
        )


def check_family(vlm_model_name: str, *families: str) -> str:
    """Return the family of a base model, one of ``families``; for ``nano`` the first.

    Raises:
        OSError: there is no config; the message names the ways out.
        ValueError: the config is another family's, or a policy's.
    """
    if vlm_model_name == NANO:
        return families[0]
    path = Path(vlm_model_name) / "config.json"
    if not path.parent.is_dir():
        path = Path(hub_file(vlm_model_name, path.name))
    if not path.is_file():
        raise FileNotFoundError(f"--policy.vlm_model_name={vlm_model_name}: the folder has no config.json")
    config = read_json(path)
    family = config.get("model_type")
    if family is None and "type" in config:
        raise ValueError(
            f"--policy.vlm_model_name={vlm_model_name} is a checkpoint of the policy {config['type']!r}; "
            f"`lerobot-bomb checkpoint export-backbone --policy.path={vlm_model_name} --output=FOLDER` makes "
            f"a folder to start from. (To train on: --policy.path={vlm_model_name})"
        )
    if family not in families:
        raise ValueError(
            f"--policy.vlm_model_name={vlm_model_name} is a {family!r} model; "
            f"this policy needs a {' or '.join(map(repr, families))} one"
        )
    return family


def read_vlm_config(vlm_model_name: str, *families: str) -> Any:
    """Read the config of a Hub id or a local folder; raises as `check_family`."""
    check_family(vlm_model_name, *families)
    return AutoConfig.from_pretrained(vlm_model_name)


@contextmanager
def weights_errors(vlm_model_name: str) -> Iterator[None]:
    """Describe what to do if the weights cannot be read."""
    try:
        yield
    except OSError as error:
        raise OSError(
            f"--policy.vlm_model_name={vlm_model_name}: no weights found. Without network, give "
            f"--policy.vlm_model_name=nano (a small model built in code) or a local folder with "
            f"model.safetensors"
        ) from error


@torch.no_grad()
def spread_images(vision_model: nn.Module) -> None:
    """Let random weights tell different images apart, and go on doing so while they are trained.

    Most of a robot's image is even and never changes: filters of zero mean turn an even patch into nothing.
    Patch and position embeddings start at unit scale. At the scale of the other weights, Adam's first hundred
    steps would add more to the vision model's biases, and every image's features would become the same.
    """
    embeddings = next(module for name, module in vision_model.named_modules() if name.endswith("embeddings"))
    filters = embeddings.get_submodule("patch_embedding").weight
    positions = embeddings.get_submodule("position_embedding").weight
    assert isinstance(filters, nn.Parameter) and isinstance(positions, nn.Parameter)
    spread_filters(filters)
    positions /= INITIALIZER_RANGE


@torch.no_grad()
def spread_filters(filters: Tensor) -> None:
    """Change the filters that embed patches, (channels, ...), as `spread_images` does."""
    filters -= filters.flatten(1).mean(dim=1).view(-1, *[1] * (filters.ndim - 1))
    filters /= INITIALIZER_RANGE


def build_backbone(
    vlm_config: dict[str, Any], image_size: int | None = None, dtype: torch.dtype = torch.float32
) -> SmolVLMBackbone:
    """Build the given architecture as `random_model` does; raises as `load_backbone`."""

    def build() -> PreTrainedModel:
        config_class, model_class = SmolVLMBackbone.classes[vlm_config["model_type"]]
        return random_model(model_class, config_class(**vlm_config), dtype)

    check_memory(vlm_config, build, dtype)
    backbone = SmolVLMBackbone(build())
    _check_image_size(backbone.image_size, image_size)
    return backbone


def random_model(
    model_class: type[PreTrainedModel], config: Any, dtype: torch.dtype, **options: Any
) -> PreTrainedModel:
    """Build a model with random weights, those of its layers' products in ``dtype``, all others in float32.

    Autocast casts products at every call, so casting them once and for all changes no output.
    """
    for part in (config, config.text_config, config.vision_config):
        part.dtype = dtype
    vlm = model_class._from_config(config, **options)
    words = vlm.get_input_embeddings(), vlm.get_output_embeddings()
    for module in vlm.modules() if dtype != torch.float32 else ():
        if not isinstance(module, PRODUCTS) or any(module is of_words for of_words in words):
            module._apply(lambda values: values.float() if values.is_floating_point() else values, False)
    return vlm


def config_dict(vlm: PreTrainedModel) -> dict[str, Any]:
    """Return the architecture as a JSON-ready dict, as `build_backbone` takes it."""
    return json.loads(vlm.config.to_json_string(use_diff=False))
