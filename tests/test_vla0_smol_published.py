"""Published tokenizers and processors of base models: question and answer as they would write them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from backbone_folders import small_model
from tokenizers import Tokenizer
from transformers import AutoProcessor, AutoTokenizer
from vla0_smol_cases import make_batch, make_policy, raw_batch, sequence

from lerobot_bomb.actions.text import END, SPACE
from lerobot_bomb.vlm.prompt import QWEN_CHAT, PromptTokens, normalize_task
from lerobot_bomb.vlm.tokenizer import load_tokenizer
from lerobot_policy_bomb.vla0_smol.modeling_vla0_smol import Vla0SmolPolicy


@pytest.fixture(scope="module")
def published_qwen(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Vla0SmolPolicy:
    """The published tokenizer on a small model."""
    folder = tmp_path_factory.mktemp("qwen")
    tokenizer: Any = AutoTokenizer.from_pretrained(shared_data / "qwen2_5_vl")
    small_model("qwen2_5_vl", tokenizer.backend_tokenizer).save_pretrained(folder)
    tokenizer.backend_tokenizer.save(str(folder / "tokenizer.json"))
    return make_policy(vlm_model_name=str(folder))


@pytest.mark.parametrize(
    "system_prompt", [None, pytest.param("Write numbers, 0 to 511.", marks=pytest.mark.long)]
)
def test_the_sequence_is_that_of_qwens_real_processor(
    published_qwen: Vla0SmolPolicy, shared_data: Path, system_prompt: str | None
) -> None:
    """Check its chat template, its image tokens, its tokenizer."""
    name = published_qwen.config.vlm_model_name
    policy = make_policy(vlm_model_name=name, system_prompt=system_prompt)
    processor: Any = AutoProcessor.from_pretrained(shared_data / "qwen2_5_vl")
    batch = make_batch(policy, 3)
    images = [np.zeros((224, 224, 3), dtype=np.uint8)] * 2
    for row, ids in enumerate(sequence(policy, batch)):
        state = " ".join(map(str, policy.state_bins.encode(batch["observation.state"][row]).tolist()))
        numbers = policy.action_bins.encode(batch["action"][row]).flatten().tolist()
        task = normalize_task(raw_batch(3)["task"][row])
        request = f"Task: {task}, State: {state}, Actions: "
        messages = [
            {"role": "user", "content": [{"type": "image"}] * 2 + [{"type": "text", "text": request}]},
            {"role": "assistant", "content": "".join(f" {number}" for number in numbers)},
        ]
        if system_prompt is not None:
            messages.insert(0, {"role": "system", "content": system_prompt})
        text = processor.apply_chat_template(messages)
        expected = processor(text=[text], images=images)["input_ids"][0]
        assert [*ids, *processor.tokenizer.encode("\n")] == list(expected)


def test_qwens_real_tokenizer_trains_and_decodes(published_qwen: Vla0SmolPolicy) -> None:
    tokens = published_qwen.tokens
    assert tokens.symbols == [*range(15, 25), 220, 151645]
    assert (tokens.image, tokens.hidden) == (151655, 151662)
    batch = make_batch(published_qwen, 2)
    assert published_qwen(batch)[0].isfinite()
    assert published_qwen.predict_action_chunk(batch).shape == (2, 3, 4)


def test_a_nano_tokenizer_serves_qwen_too() -> None:
    """Check a backbone that was exported from an `fdvla` of nano's size."""
    tokens = PromptTokens.from_tokenizer(load_tokenizer("nano"), "nano", chat=QWEN_CHAT)
    token_id = load_tokenizer("nano").token_to_id
    assert (tokens.image, tokens.symbols[END]) == (token_id("<image>"), token_id("<|im_end|>"))


def test_a_tokenizer_without_tile_tokens_writes_them_as_text(shared_data: Path) -> None:
    """Check a tokenizer as of the first 2.2B: three special tokens beside SmolLM2's, 49,155 in all."""
    stored = json.loads((shared_data / "SmolVLM2-500M-Video-Instruct" / "tokenizer.json").read_text())
    num_words = len(stored["model"]["vocab"])
    kept = [token for token in stored["added_tokens"] if token["id"] < num_words]
    edge, image, end = "<fake_token_around_image>", "<image>", "<end_of_utterance>"
    kept += [{**kept[0], "id": num_words + i, "content": text} for i, text in enumerate((edge, image, end))]
    tokenizer = Tokenizer.from_str(json.dumps({**stored, "added_tokens": kept}))
    assert tokenizer.get_vocab_size() == 49_155
    tokens = PromptTokens.from_tokenizer(tokenizer, "some/model", "Be precise.")
    images = 2 * f"{edge}<global-img>{5 * image}{edge}"
    question = f"Task: push, State: 7 45, Actions: {end}\nAssistant:"
    whole = tokenizer.encode(f"<|im_start|>System: Be precise.{end}\nUser:{images}{question}").ids
    numbers = [tokens.symbols[symbol] for symbol in (SPACE, 7, SPACE, 4, 5)]
    task = tokenizer.encode("Task: push,").ids
    assert whole == [
        *tokens.start,
        *2 * [*tokens.image_start, *5 * [tokens.image], *tokens.image_end],
        *[*task, *tokens.state_start, *numbers, *tokens.state_end, *tokens.answer_start],
    ]
    assert tokens.hidden == tokenizer.token_to_id("<empty_output>") and len(tokens.image_start) > 2
