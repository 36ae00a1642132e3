"""Tokenizers of the backbones, as `tokenizers.Tokenizer`: loading, storing as a tensor, the nano one."""

from pathlib import Path

import torch
from huggingface_hub import hf_hub_download
from tokenizers import AddedToken, Tokenizer, decoders, models, pre_tokenizers
from torch import Tensor

NANO = "nano"

IMAGE_TOKEN = "<image>"
IMAGE_EDGE_TOKEN = "<fake_token_around_image>"
GLOBAL_IMAGE_TOKEN = "<global-img>"
# tile positions go unused, because images are never tiled: the last one marks a hidden number
HIDDEN_TOKEN = "<row_6_col_6>"
SPECIAL_TOKENS = (
    "<|endoftext|>",
    "<|im_start|>",
    "<|im_end|>",
    "<end_of_utterance>",
    IMAGE_TOKEN,
    IMAGE_EDGE_TOKEN,
    GLOBAL_IMAGE_TOKEN,
    HIDDEN_TOKEN,
)

# Words that are one token in the nano tokenizer; all other text falls back to beginnings of these
# words and to bytes.
NANO_FIRST_WORDS = ("User", "Assistant", "Task")
NANO_WORDS = (
    *("State", "Actions"),
    *("place", "put", "move", "set", "push", "pick", "remove", "swap", "clear", "copy", "capture"),
    *("black", "white", "stone", "stones", "piece", "block", "object", "go", "board", "intersection"),
    *("row", "column", "position", "point", "corner", "centre", "center", "star", "edge", "target"),
    *("left", "right", "nearest", "farthest", "far", "near", "front", "back", "top", "bottom", "supply"),
    *("a", "an", "the", "at", "on", "onto", "in", "into", "to", "of", "from", "and", "then", "by", "up"),
    *("is", "it", "one", "two", "your", "next", "between", "with", "without", "counted", "all"),
)


def load_tokenizer(vlm_model_name: str) -> Tokenizer:
    """Load the tokenizer of ``nano``, a local folder or a Hub id.

    Raises:
        OSError: no ``tokenizer.json`` can be read; the message names the ways out.
    """
    if vlm_model_name == NANO:
        return nano_tokenizer()
    folder = Path(vlm_model_name)
    if folder.is_dir():
        path = folder / "tokenizer.json"
        if not path.is_file():
            raise FileNotFoundError(
                f"--policy.vlm_model_name={vlm_model_name}: the folder has no tokenizer.json"
            )
        return _whole(Tokenizer.from_file(str(path)))
    return _whole(Tokenizer.from_file(hub_file(vlm_model_name, "tokenizer.json")))


def _whole(tokenizer: Tokenizer) -> Tokenizer:
    """Turn off truncation and padding, which a tokenizer's file may ask for."""
    tokenizer.no_truncation()
    tokenizer.no_padding()
    return tokenizer


def hub_file(vlm_model_name: str, filename: str) -> str:
    """Return the path of a Hub repository's file in the local cache, downloaded if need be."""
    if vlm_model_name.count("/") > 1 or vlm_model_name.startswith((".", "~", "/")):
        raise OSError(f"--policy.vlm_model_name={vlm_model_name}: there is no such folder")
    try:
        return hf_hub_download(vlm_model_name, filename)
    except (OSError, ValueError) as error:
        raise OSError(
            f"--policy.vlm_model_name={vlm_model_name}: cannot get {filename} from the Hugging Face Hub or "
            f"its local cache. Without network, give --policy.vlm_model_name=nano (a small model built in "
            f"code) or the path of a local folder with the model's files"
        ) from error


def token_ids(tokenizer: Tokenizer, text: str) -> list[int]:
    """Return the tokens of a fixed part of a prompt, special ones included."""
    return tokenizer.encode(text, add_special_tokens=False).ids


def single_id(tokenizer: Tokenizer, vlm_model_name: str, family: str, *texts: str) -> int:
    """Return the id of the first of these texts that is exactly one token.

    Raises:
        ValueError: none is; the message names the family of tokenizers that have one.
    """
    found = [ids[0] for text in texts if len(ids := token_ids(tokenizer, text)) == 1]
    if not found:
        raise ValueError(
            f"--policy.vlm_model_name={vlm_model_name}: its tokenizer has no single token for "
            f"{' or '.join(map(repr, texts))}; the policy needs a {family} tokenizer, which has"
        )
    return found[0]


def tokenizer_to_tensor(tokenizer: Tokenizer) -> Tensor:
    """Return the tokenizer's JSON as uint8 (bytes,)."""
    return torch.frombuffer(bytearray(tokenizer.to_str().encode()), dtype=torch.uint8)


def tokenizer_from_tensor(json_bytes: Tensor) -> Tokenizer:
    """Invert `tokenizer_to_tensor`.

    Raises:
        ValueError: the bytes are no tokenizer, or not whole.
    """
    if json_bytes.dtype != torch.uint8 or json_bytes.ndim != 1:
        raise ValueError(f"a tokenizer is uint8 (bytes,), not {json_bytes.dtype} {tuple(json_bytes.shape)}")
    try:
        return _whole(Tokenizer.from_str(json_bytes.cpu().numpy().tobytes().decode()))
    except Exception as error:  # of Rust, which has no class of its own
        raise ValueError(f"the saved tokenizer cannot be read: {error}") from error


def nano_tokenizer() -> Tokenizer:
    """Build a byte-level BPE like SmolVLM's, whose only merges build the words of the task language.

    A word is merged letter by letter from its start, so a word that is not listed becomes the longest
    listed beginning and bytes. No digit takes part in a merge: every digit is one token.
    """
    alphabet = sorted(pre_tokenizers.ByteLevel.alphabet())
    vocabulary = {character: i for i, character in enumerate(alphabet)}
    merges: dict[tuple[str, str], None] = {}
    for word in (*NANO_FIRST_WORDS, *(f"Ġ{word}" for word in NANO_WORDS)):
        for length in range(1, len(word)):
            merges[word[:length], word[length]] = None
            vocabulary.setdefault(word[: length + 1], len(vocabulary))
    tokenizer = Tokenizer(models.BPE(vocab=vocabulary, merges=list(merges)))
    tokenizer.pre_tokenizer = pre_tokenizers.Sequence(
        [
            pre_tokenizers.Digits(individual_digits=True),
            pre_tokenizers.ByteLevel(add_prefix_space=False),
        ]
    )
    tokenizer.decoder = decoders.ByteLevel()
    tokenizer.add_special_tokens([AddedToken(text, special=True) for text in SPECIAL_TOKENS])
    return tokenizer
