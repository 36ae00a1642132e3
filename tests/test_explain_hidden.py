"""Hidden words beside the stock models of transformers, which are given masks and positions outright."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from explain_cases import NAMES, ask, fresh, loaded, moment, scored_by
from torch import Tensor

from lerobot_bomb.decoding.decoder import Prompt
from lerobot_bomb.decoding.decoder_layers import TextLayers
from lerobot_bomb.decoding.draft import LinearDraft
from lerobot_bomb.decoding.graph_decoder import GraphDecoder
from lerobot_bomb.decoding.kv_cache import CachedText
from lerobot_bomb.decoding.slots import GraphSlots
from lerobot_bomb.explain.masked_episodes import without_words
from lerobot_bomb.explain.question import Question
from lerobot_bomb.explain.scored_policy import ScoredPromptPolicy
from lerobot_bomb.explain.spans import span_of, token_offsets
from lerobot_bomb.viewing.checkpoint import LoadedPolicy
from lerobot_bomb.vlm.qwen import Prefix

pytestmark = pytest.mark.usefixtures("loaded_policies")


# of spatialvla_grid's prompt: a number of the state that has a digit less than it may have
GAP_OF_STATE = 65


def hidden_word(policy: LoadedPolicy, word: str) -> Tensor:
    """(1, S) bool, tokens of the instruction."""
    instruction = moment()[1]
    return span_of(word, instruction).tokens(token_offsets(policy.prepare.steps, instruction))[None]


def columns_of(question: Question, hidden_1S: Tensor) -> list[int]:
    """Return the columns of hidden words in the whole prompt."""
    assert isinstance(question.policy, ScoredPromptPolicy)
    first = question.policy.policy.layout.spans(question.rows["ids"].shape[1])["instruction"].start
    return (first + hidden_1S[0].nonzero()[:, 0]).tolist()


def bias_of(num_tokens: int, num_together: int, columns: list[int]) -> Tensor:
    """(1, 1, L, L) causal, the first tokens read each other; nothing reads these columns."""
    reads = torch.ones(num_tokens, num_tokens, dtype=torch.bool).tril()
    reads[:num_together, :num_together] = True
    reads[:, columns] = False
    return torch.zeros(1, 1, num_tokens, num_tokens).masked_fill(~reads, torch.finfo(torch.float32).min)


def smolvlm(policy: Any, columns: list[int]) -> None:
    def forward(_: Any, args: tuple, kwargs: dict[str, Any]) -> tuple[tuple, dict[str, Any]]:
        length = kwargs["inputs_embeds"].shape[1]
        outright = {
            "attention_mask": bias_of(length, 0, columns),
            "position_ids": torch.arange(length)[None],
        }
        return args, kwargs | outright

    policy.backbone.text_model.register_forward_pre_hook(forward, with_kwargs=True)


def paligemma(policy: Any, columns: list[int]) -> None:
    padding = [GAP_OF_STATE]

    def forward(_: Any, args: tuple, kwargs: dict[str, Any]) -> tuple[tuple, dict[str, Any]]:
        length = kwargs["inputs_embeds"].shape[1]
        answer = policy.config.chunk_size * len(policy.grids.groups) - 1
        together = length - answer if policy.config.prefix_attention == "bidirectional" else 0
        bias = bias_of(length, together, columns + padding)
        positions = [*range(1, GAP_OF_STATE + 1), *range(GAP_OF_STATE, length)]
        mask = {"full_attention": bias, "sliding_attention": bias}
        return args, kwargs | {"attention_mask": mask, "position_ids": torch.tensor([positions])}

    policy.backbone.text_model.register_forward_pre_hook(forward, with_kwargs=True)


def qwen(policy: Any, columns: list[int]) -> None:
    """Let the stock model read prompt and noisy actions in one pass, without a cache."""
    backbone, read = policy.backbone, {}

    def run(embeds: Tensor, bias: Tensor) -> Tensor:
        num_more = embeds.shape[1] - read["positions"].shape[2]
        more = (read["positions"].max() + 1 + torch.arange(num_more)).expand(3, 1, -1)
        positions = torch.cat([read["positions"], more], dim=2).expand(-1, len(embeds), -1)
        return backbone.text_model(
            inputs_embeds=embeds, attention_mask=bias, position_ids=positions
        ).last_hidden_state

    def read_prefix(
        embeds: Tensor, is_image: Tensor, mask: Tensor, hidden: Tensor | None = None, num_shared: int = 0
    ) -> Prefix:
        ids = torch.where(is_image, backbone.vlm.config.image_token_id, 0)
        side = backbone.tokens_per_side * 2
        grids = torch.tensor([[1, side, side]] * (int(is_image[0].sum()) // backbone.tokens_per_image))
        read["embeds"] = embeds
        read["positions"] = backbone.vlm.model.get_rope_index(ids[:1], is_image[:1].int(), grids)[0]
        states = run(embeds, bias_of(embeds.shape[1], 0, columns))
        return Prefix(states, mask, torch.zeros(len(embeds), 1, dtype=torch.int64), [])

    def read_segment(prefix: Prefix, embeds: Tensor, reads: Tensor, num_copies: int = 1) -> Tensor:
        num_new = embeds.shape[1] // num_copies
        parts = [slice(start, start + num_new) for start in range(0, embeds.shape[1], num_new)]
        return torch.cat([read_copy(embeds[:, part], reads[:, part, part]) for part in parts], dim=1)

    def read_copy(embeds: Tensor, reads: Tensor) -> Tensor:
        whole = torch.cat([read["embeds"].expand(len(embeds), -1, -1), embeds], dim=1)
        bias = bias_of(whole.shape[1], 0, columns).repeat(len(embeds), 1, 1, 1)
        num_new = embeds.shape[1]
        bias[:, 0, -num_new:, -num_new:] = torch.where(reads, 0.0, torch.finfo(torch.float32).min)
        return run(whole, bias)[:, -num_new:]

    backbone.read_prefix, backbone.read_segment = read_prefix, read_segment


STOCK: dict[str, Callable[[Any, list[int]], None]] = {
    "vla0_smol": smolvlm,
    "spatialvla_grid": paligemma,
    "fdvla": qwen,
}


@pytest.mark.parametrize("word", ["black", "3", "row 1, column 3"])
@pytest.mark.parametrize("name", NAMES)
def test_a_hidden_word_is_masked_for_all_others_and_moves_none(name: str, word: str) -> None:
    policy = fresh(name)
    question = ask(policy)
    hidden = hidden_word(policy, word)
    rows = question.policy.hide(question.rows, hidden)
    with torch.no_grad():
        score = question.policy.score(rows, question.answer)
        STOCK[name](policy.policy, columns_of(question, hidden))
        expected = question.policy.score(rows, question.answer)
    assert abs(float(expected) - question.clean_score) > 1e-4
    torch.testing.assert_close(score, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_the_stock_model_agrees_where_nothing_is_hidden(name: str) -> None:
    policy = fresh(name)
    question = ask(policy)
    STOCK[name](policy.policy, [])
    with torch.no_grad():
        expected = question.policy.score(question.rows, question.answer)
    assert float(expected) == pytest.approx(question.clean_score, rel=1e-5, abs=1e-5)


def hidden_batch(policy: LoadedPolicy, word: str) -> dict[str, Any]:
    """Return the batch that an episode under the mask of a word has in place of this observation."""
    observation, instruction, _, _ = moment()
    mask = without_words(policy, {instruction: span_of(word, instruction)}.get)
    prepared = policy.prepare(policy.observe([observation], [instruction]))
    assert mask.change_prepared(prepared, "another instruction") is prepared
    return mask.change_prepared(prepared, instruction)


@pytest.mark.parametrize("name", NAMES)
def test_in_whole_episodes_the_same_tokens_are_hidden(name: str) -> None:
    policy = loaded(name)
    question = ask(policy)
    rows = question.policy.encode(hidden_batch(policy, "3"))
    expected = question.policy.hide(question.rows, hidden_word(policy, "3"))
    assert torch.equal(rows["hidden"], expected["hidden"]) and torch.equal(rows["mask"], expected["mask"])


def written_by_graphs(policy: Any, batch: dict[str, Any]) -> Tensor:
    """Numbers by the passes that are recorded on CUDA, one after the other."""
    prompt, grammar, backbone = policy.prompt(batch), policy.grammar, policy.backbone
    num_numbers = grammar.num_numbers
    num_columns = prompt.ids.shape[1] + grammar.max_symbols(num_numbers)
    layers = TextLayers(backbone.text_model, copy_dtype=torch.float32)
    text = CachedText(layers, 1, num_columns, policy._positions)
    rows = backbone.embed_tokens(policy.symbol_ids), backbone.vlm.lm_head.weight[policy.symbol_ids]
    recorded = GraphDecoder(grammar, LinearDraft(grammar, 4), *rows, text)
    recorded(Prompt(policy.embed(prompt.ids, policy.encode_images(batch)), prompt.mask), *rows, num_numbers)
    return recorded(
        Prompt(policy.embed(prompt.ids, policy.encode_images(batch)), prompt.mask, prompt.hidden),
        *rows,
        num_numbers,
    ).numbers


def chosen_by_graphs(policy: Any, batch: dict[str, Any]) -> Tensor:
    """Cells in the same way."""
    prompt, backbone, num_steps = policy.prompt(batch), policy.backbone, policy.config.chunk_size
    num_slots = num_steps * len(policy.grids.groups)
    layers = TextLayers(backbone.text_model, copy_dtype=torch.float32)
    text = CachedText(layers, 1, prompt.ids.shape[1] + num_slots, backbone.positions)
    rows = policy.cell_embedding.weight * backbone.embed_scale, policy.cell_head.weight
    settings = policy._group_rows, num_steps, policy._bidirectional_prompt, backbone.cap
    recorded = GraphSlots(*settings, *rows, text)
    noise = torch.zeros(1, 0, len(rows[1]))
    embeds = policy.embed(prompt.ids, policy.encode_images(batch))
    recorded(Prompt(embeds, prompt.mask), *rows, noise)
    return recorded(Prompt(embeds, prompt.mask, prompt.hidden), *rows, noise)[0]


@torch.no_grad()
@pytest.mark.parametrize(
    ("name", "by_graphs"), [("vla0_smol", written_by_graphs), ("spatialvla_grid", chosen_by_graphs)]
)
@pytest.mark.parametrize("word", ["3", "row 1, column 3"])
def test_captured_passes_hide_the_same(name: str, by_graphs: Callable[..., Tensor], word: str) -> None:
    """Check a pass after a prompt of which nothing was hidden."""
    policy = loaded(name)
    batch = hidden_batch(policy, word)
    answer = scored_by(policy).answer(batch)
    assert torch.equal(by_graphs(policy.policy, batch).flatten(), answer.flatten())
    clean = ask(policy).answer
    assert word == "3" or not torch.equal(answer, clean)
