"""The fixed parts of the prompt as token ids, for any tokenizer of the SmolVLM family.

The whole sequence is, in SmolVLM2's chat format:

    <|im_start|>User:IMG...IMGTask: {task}, State: s1 ... sS, Actions: <end_of_utterance>
    Assistant: a1 a2 ... an<end_of_utterance>

with IMG = ``<fake_token_around_image><global-img><image>...<image><fake_token_around_image>``. A system
prompt stands before ``User:`` as ``System: {text}<end_of_utterance>`` and a line break. The sequence is cut
where the tokenizer cuts anyway (at special tokens, between ``,`` and a space, at digits), so the pieces'
tokens in a row are the tokens of the whole string.
"""

import re
from dataclasses import asdict, dataclass
from itertools import takewhile

from tokenizers import Tokenizer

from lerobot_bomb.actions.text import END, MAX_DIGITS, SYMBOL_TEXTS
from lerobot_bomb.vlm.tokenizer import GLOBAL_IMAGE_TOKEN, HIDDEN_TOKEN, IMAGE_EDGE_TOKEN, IMAGE_TOKEN

TASK_TEMPLATE = "Task: {},"


@dataclass(frozen=True)
class PromptTokens:
    """Token ids of everything in a sequence but the task."""

    symbols: list[int]  # digits 0-9, space, <end_of_utterance>
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
        cls, tokenizer: Tokenizer, vlm_model_name: str, system_prompt: str | None = None
    ) -> "PromptTokens":
        """Look everything up.

        Raises:
            ValueError: a digit, the space or a special token is not exactly one token of its own, or not
                everywhere.
        """

        def one(text: str) -> int:
            ids = tokenizer.encode(text).ids
            if len(ids) != 1:
                raise ValueError(
                    f"--policy.vlm_model_name={vlm_model_name}: its tokenizer writes {text!r} as {len(ids)} "
                    f"tokens; the policy needs a SmolVLM-family tokenizer, where it is exactly one"
                )
            return ids[0]

        def several(text: str) -> list[int]:
            return tokenizer.encode(text).ids

        symbols = [one(text) for text in SYMBOL_TEXTS]
        _check_distinct(symbols, vlm_model_name)
        _check_numbers(tokenizer, symbols, vlm_model_name)
        end = one(SYMBOL_TEXTS[-1])
        system = []
        if system_prompt is not None:
            system = [*text_ids(tokenizer, f"System: {system_prompt}"), end, *several("\n")]
        return cls(
            symbols=symbols,
            hidden=one(HIDDEN_TOKEN),
            start=[one("<|im_start|>"), *system, *several("User:")],
            image_start=[one(IMAGE_EDGE_TOKEN), one(GLOBAL_IMAGE_TOKEN)],
            image=one(IMAGE_TOKEN),
            image_end=[one(IMAGE_EDGE_TOKEN)],
            state_start=several(" State:"),
            state_end=several(","),
            answer_start=[*several(" Actions: "), end, *several("\nAssistant:")],
            system_prompt=system_prompt,
        )

    def to_dict(self) -> dict[str, int | list[int] | str | None]:
        """JSON-ready."""
        return asdict(self)


def _check_distinct(symbol_ids: list[int], vlm_model_name: str) -> None:
    """Raise if two symbols are the same token, as all that a tokenizer does not know are."""
    texts: dict[int, str] = {}
    for text, token in zip(SYMBOL_TEXTS, symbol_ids, strict=True):
        if token in texts:
            raise ValueError(
                f"--policy.vlm_model_name={vlm_model_name}: its tokenizer writes {texts[token]!r} and "
                f"{text!r} as the same token; the policy needs one of its own for every digit and for a "
                f"lone space"
            )
        texts[token] = text


def _check_numbers(tokenizer: Tokenizer, symbol_ids: list[int], vlm_model_name: str) -> None:
    """Raise unless every number of up to MAX_DIGITS digits is a space and one token a digit, where it stands.

    The policy turns numbers into tokens by arithmetic and asks no tokenizer: this is its only check. 0.2 s.
    """
    ids: dict[str, int] = dict(zip(SYMBOL_TEXTS, symbol_ids, strict=True))
    numbers = [f" {number:0{width}}" for width in range(1, MAX_DIGITS + 1) for number in range(10**width)]
    # all of them one after the other, and every digit as the last
    answers = ["".join(numbers), *numbers[:10]]
    for before, after in ((" State:", ","), ("Assistant:", SYMBOL_TEXTS[END])):
        start, end = tokenizer.encode(before).ids, tokenizer.encode(after).ids
        for answer in answers:
            text = f"{before}{answer}{after}"
            written = tokenizer.encode(text)
            expected = [*start, *(ids[symbol] for symbol in answer), *end]
            if written.ids != expected:
                same = takewhile(lambda pair: pair[0] == pair[1], zip(written.ids, expected, strict=False))
                first, last = written.offsets[min(len(list(same)), len(written.ids) - 1)]
                raise ValueError(
                    f"--policy.vlm_model_name={vlm_model_name}: its tokenizer merges digits or spaces "
                    f"({text[first:last]!r} in {text[max(0, first - 5) : last + 5]!r}); the policy needs one "
                    f"token a digit and one for a lone space"
                )


def normalize_task(task: str) -> str:
    """Lower case, underscores and line breaks as spaces, no outer spaces."""
    return re.sub(r"[_\r\n]", " ", task.lower()).strip()


def task_text(task: str, template: str = TASK_TEMPLATE) -> str:
    """The prompt's task part; ``{}`` in the template stands for the task."""
    return template.format(normalize_task(task))


def task_ids(tokenizer: Tokenizer, task: str, template: str = TASK_TEMPLATE) -> list[int]:
    """Tokens of the prompt's task part."""
    return text_ids(tokenizer, task_text(task, template))


def text_ids(tokenizer: Tokenizer, text: str) -> list[int]:
    """Tokens of a user's text; what looks like a special token stays text."""
    tokenizer.encode_special_tokens = True
    try:
        return tokenizer.encode(text, add_special_tokens=False).ids
    finally:
        tokenizer.encode_special_tokens = False
