"""Fixed parts of the prompt as token ids, in the chat format of a family of models.

The whole sequence is, in SmolVLM's:

    <|im_start|>User:IMG...IMGTask: {task}, State: s1 ... sS, Actions: <end_of_utterance>
    Assistant: a1 a2 ... an<end_of_utterance>

with IMG = ``<fake_token_around_image><global-img><image>...<image><fake_token_around_image>``. A system
prompt precedes ``User:`` as ``System: {text}<end_of_utterance>`` and a line break. In Qwen2.5-VL's:

    <|im_start|>system
    You are a helpful assistant.<|im_end|>
    <|im_start|>user
    IMG...IMGTask: {task}, State: s1 ... sS, Actions: <|im_end|>
    <|im_start|>assistant
     a1 a2 ... an<|im_end|>

with IMG = ``<|vision_start|><|image_pad|>...<|image_pad|><|vision_end|>``. The sequence is cut where the
tokenizer cuts anyway (at special tokens, between ``,`` and a space, at digits), so the pieces' tokens in a
row are the tokens of the whole string.
"""

import re
from dataclasses import asdict, dataclass
from functools import partial
from itertools import takewhile

from tokenizers import Tokenizer

from lerobot_bomb.actions.text import MAX_DIGITS, SYMBOL_TEXTS
from lerobot_bomb.vlm.tokenizer import (
    GLOBAL_IMAGE_TOKEN,
    HIDDEN_TOKEN,
    IMAGE_EDGE_TOKEN,
    IMAGE_TOKEN,
    single_id,
    token_ids,
)

TASK_TEMPLATE = "Task: {},"


@dataclass(frozen=True)
class ChatFormat:
    """Chat format of a family of models: the tokens around the user's texts and its own."""

    family: str  # of its tokenizers, in messages
    start: str  # of the sequence
    system: str  # message; {} is its text
    default_system: str | None  # its text where the user gives none; None: there is no such message
    end: str  # of every message
    turn: str  # between that and who speaks next
    user: str
    assistant: str
    # single tokens: the first that a tokenizer has
    image_start: tuple[str, ...]
    image: tuple[str, ...]
    image_end: tuple[str, ...]
    hidden: tuple[str, ...]  # for a hidden number: in no other use here
    image_label: str = ""  # after an image's start

    def opening(self, tokenizer: Tokenizer, vlm_model_name: str, system_prompt: str | None) -> list[int]:
        """Return the tokens before the user's images; raises as `single_id`."""
        ids = [single_id(tokenizer, vlm_model_name, self.family, self.start)]
        text = self.default_system if system_prompt is None else system_prompt
        if text is not None:
            ids += text_ids(tokenizer, self.system.format(text))
            ids += self._next(tokenizer, vlm_model_name)
        return [*ids, *token_ids(tokenizer, self.user)]

    def reply(self, tokenizer: Tokenizer, vlm_model_name: str) -> list[int]:
        """Return the tokens between the user's text and the model's; raises as `single_id`."""
        return [*self._next(tokenizer, vlm_model_name), *token_ids(tokenizer, self.assistant)]

    def _next(self, tokenizer: Tokenizer, vlm_model_name: str) -> list[int]:
        end = single_id(tokenizer, vlm_model_name, self.family, self.end)
        return [end, *token_ids(tokenizer, self.turn)]


SMOLVLM_CHAT = ChatFormat(
    family="SmolVLM",
    start="<|im_start|>",
    system="System: {}",
    default_system=None,
    end="<end_of_utterance>",
    turn="\n",
    user="User:",
    assistant="Assistant:",
    image_start=(IMAGE_EDGE_TOKEN,),
    image=(IMAGE_TOKEN,),
    image_end=(IMAGE_EDGE_TOKEN,),
    # the second is of SmolLM2, and in the tokenizers of the first 2.2B, which have no tile positions
    hidden=(HIDDEN_TOKEN, "<empty_output>"),
    image_label=GLOBAL_IMAGE_TOKEN,
)
# the last of several tokens is the nano tokenizer's
QWEN_CHAT = ChatFormat(
    family="Qwen2.5-VL",
    start="<|im_start|>",
    system="system\n{}",
    default_system="You are a helpful assistant.",
    end="<|im_end|>",
    turn="\n<|im_start|>",
    user="user\n",
    assistant="assistant\n",
    image_start=("<|vision_start|>", IMAGE_EDGE_TOKEN),
    image=("<|image_pad|>", IMAGE_TOKEN),
    image_end=("<|vision_end|>", IMAGE_EDGE_TOKEN),
    hidden=("<|fim_pad|>", HIDDEN_TOKEN),
)


@dataclass(frozen=True)
class PromptTokens:
    """Token ids of everything in a sequence but the task."""

    symbols: list[int]  # digits 0-9, space, end of a message
    hidden: int  # stands for a hidden number
    start: list[int]  # before the images, with the system prompt
    image_start: list[int]
    image: int
    image_end: list[int]
    state_start: list[int]
    state_end: list[int]
    answer_start: list[int]
    system_prompt: str | None = None

    @classmethod
    def from_tokenizer(
        cls,
        tokenizer: Tokenizer,
        vlm_model_name: str,
        system_prompt: str | None = None,
        chat: ChatFormat = SMOLVLM_CHAT,
    ) -> "PromptTokens":
        """Look up all tokens.

        Raises:
            ValueError: a digit, the space or a special token is not exactly one token of its own, or not
                everywhere.
        """
        several = partial(token_ids, tokenizer)
        one = partial(single_id, tokenizer, vlm_model_name, chat.family)
        symbols = {text: one(text) for text in (*SYMBOL_TEXTS, chat.end)}
        _check_distinct(symbols, vlm_model_name)
        _check_numbers(tokenizer, symbols, chat, vlm_model_name)
        return cls(
            symbols=list(symbols.values()),
            hidden=one(*chat.hidden),
            start=chat.opening(tokenizer, vlm_model_name, system_prompt),
            image_start=[one(*chat.image_start), *several(chat.image_label)],
            image=one(*chat.image),
            image_end=[one(*chat.image_end)],
            state_start=several(" State:"),
            state_end=several(","),
            answer_start=[*several(" Actions: "), *chat.reply(tokenizer, vlm_model_name)],
            system_prompt=system_prompt,
        )

    def to_dict(self) -> dict[str, int | list[int] | str | None]:
        """Return a JSON-ready dict."""
        return asdict(self)


def _check_distinct(symbols: dict[str, int], vlm_model_name: str) -> None:
    """Raise if two symbols are the same token, as all unknown ones are."""
    texts: dict[int, str] = {}
    for text, token in symbols.items():
        if token in texts:
            raise ValueError(
                f"--policy.vlm_model_name={vlm_model_name}: its tokenizer writes {texts[token]!r} and "
                f"{text!r} as the same token; the policy needs one of its own for every digit and for a "
                f"lone space"
            )
        texts[token] = text


def _check_numbers(
    tokenizer: Tokenizer, symbols: dict[str, int], chat: ChatFormat, vlm_model_name: str
) -> None:
    """Raise unless every number of up to MAX_DIGITS digits is a space and one token per digit in place.

    The policy turns numbers into tokens by arithmetic, without a tokenizer; only this, in 0.2 s, checks it.
    """
    numbers = [f" {number:0{width}}" for width in range(1, MAX_DIGITS + 1) for number in range(10**width)]
    # all of them one after the other, and every digit as the last
    answers = ["".join(numbers), *numbers[:10]]
    for before, after in ((" State:", ","), (chat.turn + chat.assistant, chat.end)):
        start, end = token_ids(tokenizer, before), token_ids(tokenizer, after)
        for answer in answers:
            text = f"{before}{answer}{after}"
            written = tokenizer.encode(text, add_special_tokens=False)
            expected = [*start, *(symbols[symbol] for symbol in answer), *end]
            if written.ids != expected:
                same = takewhile(lambda pair: pair[0] == pair[1], zip(written.ids, expected, strict=False))
                first, last = written.offsets[min(len(list(same)), len(written.ids) - 1)]
                raise ValueError(
                    f"--policy.vlm_model_name={vlm_model_name}: its tokenizer merges digits or spaces "
                    f"({text[first:last]!r} in {text[max(0, first - 5) : last + 5]!r}); the policy needs one "
                    f"token a digit and one for a lone space"
                )


def normalize_task(task: str) -> str:
    """Write a task in lower case, with spaces for underscores and line breaks, and without outer spaces."""
    return re.sub(r"[_\r\n]", " ", task.lower()).strip()


def check_template(template: object, name: str) -> None:
    """Raise a ValueError unless the template holds ``{}`` once, for the instruction.

    ``name``: what the message calls the template.
    """
    if not isinstance(template, str) or re.findall(r"[{}]+", template) != ["{}"]:
        raise ValueError(f"{name}={template!r} must hold {{}} once, for the task, and no other brace")


def task_text(task: str, template: str = TASK_TEMPLATE) -> str:
    """Return the prompt's task part; ``{}`` in the template stands for the task."""
    return template.format(normalize_task(task))


def task_ids(tokenizer: Tokenizer, task: str, template: str = TASK_TEMPLATE) -> list[int]:
    """Return the tokens of the prompt's task part."""
    return text_ids(tokenizer, task_text(task, template))


def text_ids(tokenizer: Tokenizer, text: str) -> list[int]:
    """Return the tokens of a user's text; text that looks like a special token stays text."""
    tokenizer.encode_special_tokens = True
    try:
        return tokenizer.encode(text, add_special_tokens=False).ids
    finally:
        tokenizer.encode_special_tokens = False
