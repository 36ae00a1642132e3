"""The peer of train_speed.py: a SmolVLM trained on texts and images, as its processor takes them."""

from collections.abc import Callable
from typing import Any

import torch
from lerobot.utils.constants import ACTION, OBS_STATE
from PIL import Image
from torch import Tensor
from torch.utils.data import default_collate
from transformers import PreTrainedTokenizerFast, SmolVLMProcessor
from transformers.models.smolvlm.image_processing_pil_smolvlm import SmolVLMImageProcessorPil
from transformers.models.smolvlm.video_processing_smolvlm import SmolVLMVideoProcessor

from lerobot_bomb.vlm.prompt import normalize_task
from lerobot_bomb.vlm.tokenizer import load_tokenizer

IGNORED = -100
# SmolVLM2's chat format
TEMPLATE = """<|im_start|>{% for message in messages %}{{ message.role.capitalize() }}:\
{{ '' if message.content[0].type == 'image' else ' ' }}\
{% for part in message.content %}{{ '<image>' if part.type == 'image' else part.text }}{% endfor %}\
<end_of_utterance>
{% endfor %}"""


class StringPath:
    """Loss of the stock model; a deep copy of the policy lends its weights, bins and crop."""

    def __init__(self, policy: Any, preprocessor: Callable, *, do_resize: bool):
        self.policy, self.preprocessor, self.do_resize = policy, preprocessor, do_resize
        self.processor: Any = make_processor(policy.backbone.image_size, policy.backbone.tokens_per_image)
        self.tokenizer = self.processor.tokenizer
        self.turn_ids = self.tokenizer.encode("\nAssistant:")

    def loss(self, items: list[dict]) -> Tensor:
        batch = self.preprocessor(default_collate(items))
        texts = self.texts(batch)
        inputs = self.processor(
            text=texts,
            images=self.images(batch),
            do_resize=self.do_resize,
            do_image_splitting=False,
            padding=True,
            return_tensors="pt",
        )
        return self.policy.backbone.vlm(**inputs, labels=self.labels(inputs["input_ids"])).loss

    def texts(self, batch: dict[str, Any]) -> list[str]:
        """Prompt and answer of every sample."""
        states = self.policy.state_bins.encode(batch[OBS_STATE])
        actions = self.policy.action_bins.encode(batch[ACTION]).flatten(1)
        return [
            self.processor.apply_chat_template(self.conversation(task, state, numbers))
            for task, state, numbers in zip(batch["task"], states.tolist(), actions.tolist(), strict=True)
        ]

    def conversation(self, task: str, state: list[int], numbers: list[int]) -> list[dict[str, Any]]:
        """Write the conversation: what the user shows and asks, and what is answered."""
        request = f"Task: {normalize_task(task)}, State: {' '.join(map(str, state))}, Actions: "
        images = [{"type": "image"}] * len(self.policy.config.image_features)
        return [
            {"role": "user", "content": [*images, {"type": "text", "text": request}]},
            {"role": "assistant", "content": [{"type": "text", "text": " ".join(map(str, numbers))}]},
        ]

    def images(self, batch: dict[str, Any]) -> list[list[Image.Image]]:
        """Cropped images of every sample, one a camera."""
        cameras = [batch[key] for key in sorted(self.policy.config.image_features)]
        return [[self.crop(image) for image in images] for images in zip(*cameras, strict=True)]

    def crop(self, image_3HW: Tensor) -> Image.Image:
        """A window at a random place while training, else at the centre."""
        height, width = image_3HW.shape[1:]
        fraction = self.policy.config.crop_fraction
        sides = [round(height * fraction), round(width * fraction)]
        room = [height - sides[0], width - sides[1]]
        if self.policy.training:
            top, left = (int(torch.randint(free + 1, ())) for free in room)
        else:
            top, left = (free // 2 for free in room)
        levels = (image_3HW.permute(1, 2, 0) * 255).round().byte().numpy()
        return Image.fromarray(levels).crop((left, top, left + sides[1], top + sides[0]))

    def labels(self, ids_BL: Tensor) -> Tensor:
        """The tokens after ``Assistant:`` up to <end_of_utterance>, all others IGNORED."""
        is_end_BL = ids_BL == self.tokenizer.eos_token_id
        ends_before_BL = is_end_BL.cumsum(dim=1) - is_end_BL.long()
        turn_start_B1 = is_end_BL.int().argmax(dim=1, keepdim=True)
        in_turn_BL = torch.arange(ids_BL.shape[1]) > turn_start_B1 + len(self.turn_ids)
        return ids_BL.masked_fill(~((ends_before_BL == 1) & in_turn_BL), IGNORED)


def make_processor(image_size: int, tokens_per_image: int) -> SmolVLMProcessor:
    """SmolVLM's processor for the nano model, in the proportions of the published one."""
    tokenizer = PreTrainedTokenizerFast(
        tokenizer_object=load_tokenizer("nano"),
        bos_token="<|im_start|>",
        eos_token="<end_of_utterance>",
        pad_token="<|im_end|>",
        padding_side="right",
    )
    image_processor = SmolVLMImageProcessorPil(
        size={"longest_edge": 4 * image_size}, max_image_size={"longest_edge": image_size}
    )
    return SmolVLMProcessor(
        image_processor,
        tokenizer,
        SmolVLMVideoProcessor(),
        image_seq_len=tokens_per_image,
        chat_template=TEMPLATE,
    )
