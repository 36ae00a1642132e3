"""The decoder on a model, against the model's own full passes and transformers' `generate`."""

import copy
from pathlib import Path
from typing import Any

import pytest
import torch
from grammar_processor import GrammarProcessor
from torch import Tensor
from transformers import AutoTokenizer

from lerobot_bomb.actions.text import END, NUM_SYMBOLS, SPACE, SYMBOL_TEXTS, TokenRows
from lerobot_bomb.decoding.decoder import CachedContinuation, Prompt, decode_numbers
from lerobot_bomb.decoding.decoder_layers import TextLayers
from lerobot_bomb.decoding.draft import KnownSymbols, LinearDraft
from lerobot_bomb.decoding.grammar import NumberGrammar
from lerobot_bomb.decoding.graph_cache import GraphCache
from lerobot_bomb.decoding.graph_decoder import GraphDecoder
from lerobot_bomb.decoding.kv_cache import CachedText, Positions, same_positions
from lerobot_bomb.decoding.plain_layers import hidden_states
from lerobot_bomb.decoding.writer import continue_prompt
from lerobot_bomb.vlm.backbone import SmolVLMBackbone, build_backbone, load_backbone
from lerobot_bomb.vlm.paligemma import build_paligemma
from lerobot_bomb.vlm.presets import nano_config, nano_paligemma_config, nano_qwen_config
from lerobot_bomb.vlm.qwen import build_qwen
from lerobot_bomb.vlm.tokenizer import NANO, load_tokenizer

SYMBOL_IDS = torch.arange(20, 20 + NUM_SYMBOLS)


@pytest.fixture(scope="module")
def backbone() -> SmolVLMBackbone:
    torch.manual_seed(0)
    return load_backbone("nano").eval()


def prompts(backbone: SmolVLMBackbone, seed: int, lengths: list[int]) -> TokenRows:
    generator = torch.Generator().manual_seed(seed)
    ids = torch.randint(40, 300, (len(lengths), max(lengths)), generator=generator)
    return TokenRows(ids, torch.arange(max(lengths)) < torch.tensor(lengths)[:, None])


def continuation(
    backbone: SmolVLMBackbone, rows: TokenRows, max_symbols: int, symbol_ids: Tensor = SYMBOL_IDS
) -> CachedContinuation:
    prompt = Prompt(backbone.embed_tokens(rows.ids), rows.mask)
    return continue_prompt(backbone, prompt, symbol_ids, max_symbols)


def vocabulary(shared_data: Path, name: str) -> tuple[SmolVLMBackbone, Tensor]:
    """A nano backbone with the vocabulary of a real tokenizer, and the ids of the symbols in it."""
    tokenizer: Any = AutoTokenizer.from_pretrained(str(shared_data / name))
    ids = [tokenizer.convert_tokens_to_ids(tokenizer.tokenize(text)) for text in SYMBOL_TEXTS]
    symbol_ids = torch.tensor([*ids, [tokenizer.eos_token_id]])[:, 0]
    config = nano_config(load_tokenizer(NANO))
    config["text_config"]["vocab_size"] = len(tokenizer)
    torch.manual_seed(0)
    return build_backbone(config).eval(), symbol_ids


@torch.no_grad()
def test_the_cache_gives_the_logits_of_a_full_pass(backbone: SmolVLMBackbone) -> None:
    """Rows of different lengths that get on differently far, one of them twice over the same columns."""
    rows = prompts(backbone, 0, [9, 4])
    said = torch.tensor([[3, 10, 4, 1, 9, 10, 2], [10, 8, 5, 7, 1, 10, 6]])
    model = continuation(backbone, rows, 9)
    model(said[:, :2], torch.tensor([0, 0]))
    model(torch.tensor([[4, 1, 9], [0, 0, 0]]), torch.tensor([2, 2]))  # wrong guesses in the second row
    cached = model(torch.stack([said[0, 5:7], said[1, 2:4]]), torch.tensor([5, 2]))
    for row, (length, num_said) in enumerate([(9, 7), (4, 4)]):
        full = torch.cat([rows.ids[row, :length], SYMBOL_IDS[said[row, :num_said]]])[None]
        expected = backbone.logits(backbone.hidden_states(backbone.embed_tokens(full)))[0, -2:, SYMBOL_IDS]
        torch.testing.assert_close(cached[row], expected)


@torch.no_grad()
def test_the_cache_in_bfloat16_is_as_exact_as_a_full_pass(backbone: SmolVLMBackbone) -> None:
    rows = prompts(backbone, 0, [9])
    said = torch.tensor([[3, 10, 4, 1]])
    full = torch.cat([rows.ids[0], SYMBOL_IDS[said[0]]])[None]
    exact = backbone.logits(backbone.hidden_states(backbone.embed_tokens(full)))[0, -4:, SYMBOL_IDS]
    with torch.autocast("cpu", dtype=torch.bfloat16):
        whole = backbone.logits(backbone.hidden_states(backbone.embed_tokens(full)))[0, -4:, SYMBOL_IDS]
        model = continuation(backbone, rows, 9)
        cached = torch.cat([model(said[:, :2], torch.tensor([0])), model(said[:, 2:], torch.tensor([2]))], 1)[
            0
        ]
    assert cached.dtype == torch.float32  # of the head; the cache is in bfloat16
    error, error_of_whole = ((logits.float() - exact).abs().max() for logits in (cached, whole))
    assert 0 < error < 2 * error_of_whole


@torch.no_grad()
def test_adapters_count(backbone: SmolVLMBackbone) -> None:
    """A head or a projection that a module wraps, as PEFT does."""

    class Doubled(torch.nn.Module):
        def __init__(self, base: torch.nn.Module):
            super().__init__()
            self.base = base

        def forward(self, x: Tensor) -> Tensor:
            return 2 * self.base(x)

    adapted = copy.deepcopy(backbone)
    vlm: Any = adapted.vlm
    vlm.lm_head = Doubled(vlm.lm_head)
    layer: Any = adapted.vlm.model.text_model.get_submodule("layers.1")
    layer.self_attn.v_proj = Doubled(layer.self_attn.v_proj)
    rows, said = prompts(backbone, 0, [9]), torch.tensor([[3, 10, 4]])
    full = torch.cat([rows.ids[0], SYMBOL_IDS[said[0]]])[None]
    expected = adapted.logits(adapted.hidden_states(adapted.embed_tokens(full)))[0, -3:, SYMBOL_IDS]
    cached = continuation(adapted, rows, 9)(said, torch.tensor([0]))[0]
    torch.testing.assert_close(cached, expected)
    assert not torch.allclose(cached, continuation(backbone, rows, 9)(said, torch.tensor([0]))[0])


def generated(backbone: SmolVLMBackbone, rows: TokenRows, symbol_ids: Tensor) -> list[list[int]]:
    """Write as transformers' own greedy search with its own cache, left-padded: 12 numbers below 512."""
    lengths = rows.mask.sum(dim=1).tolist()
    longest = max(lengths) + 1
    ids = torch.zeros(len(lengths), longest, dtype=torch.long)
    mask = torch.zeros_like(ids)
    for row, length in enumerate(lengths):
        ids[row, -length - 1 :] = torch.cat([rows.ids[row, :length], symbol_ids[SPACE : SPACE + 1]])
        mask[row, -length - 1 :] = 1
    model: Any = backbone.vlm
    end_id = int(symbol_ids[END])
    processor = GrammarProcessor(512, 12, longest, symbol_ids)
    written = model.generate(
        input_ids=ids,
        attention_mask=mask,
        max_new_tokens=12 * 4,
        do_sample=False,
        logits_processor=[processor],
        eos_token_id=end_id,
        pad_token_id=end_id,
    )
    return processor.read(written)


def ours(backbone: SmolVLMBackbone, rows: TokenRows, symbol_ids: Tensor, *, drafted: bool) -> list[list[int]]:
    grammar = NumberGrammar(512, 12)
    guess = LinearDraft(grammar, 3) if drafted else KnownSymbols(grammar)
    model = continuation(backbone, rows, grammar.max_symbols(12), symbol_ids)
    return decode_numbers(model, grammar, guess, batch_size=len(rows.ids), stop_after=12).numbers.tolist()


LENGTHS = [30, 24, 17, 30, 5, 12, 29, 30]


@torch.no_grad()
@pytest.mark.parametrize("lengths", [[30], LENGTHS])
@pytest.mark.parametrize("drafted", [False, True])
def test_it_writes_what_generate_writes(backbone: SmolVLMBackbone, lengths: list[int], drafted: bool) -> None:
    for seed in range(4):
        rows = prompts(backbone, seed, lengths)
        assert ours(backbone, rows, SYMBOL_IDS, drafted=drafted) == generated(backbone, rows, SYMBOL_IDS)


@torch.no_grad()
@pytest.mark.parametrize("name", ["SmolVLM2-500M-Video-Instruct", "qwen2_5_vl"])
def test_it_does_so_in_real_vocabularies(shared_data: Path, name: str) -> None:
    backbone, symbol_ids = vocabulary(shared_data, name)
    assert len(set(symbol_ids.tolist())) == NUM_SYMBOLS
    for seed, lengths in enumerate([[30], LENGTHS]):
        rows = prompts(backbone, seed, lengths)
        expected = generated(backbone, rows, symbol_ids)
        assert ours(backbone, rows, symbol_ids, drafted=True) == expected
        assert ours(backbone, rows, symbol_ids, drafted=False) == expected


@torch.no_grad()
def test_on_a_copy_it_writes_what_the_model_writes_now(backbone: SmolVLMBackbone) -> None:
    """The way that is recorded on CUDA, step by step; prompts have padding there."""
    grammar, changing = NumberGrammar(512, 12), copy.deepcopy(backbone)
    guess = LinearDraft(grammar, 3)
    layers = TextLayers(changing.vlm.model.text_model, copy_dtype=torch.float32)
    head, max_symbols = changing.vlm.lm_head, grammar.max_symbols(12)
    embeds_SH, head_SH = changing.embed_tokens(SYMBOL_IDS), head.weight[SYMBOL_IDS]
    text = CachedText(layers, len(LENGTHS), max(LENGTHS) + 3 + max_symbols)
    recorded = GraphDecoder(grammar, guess, embeds_SH, head_SH, text)
    answers = []
    for seed in range(3):
        rows = prompts(changing, seed, LENGTHS)
        gap = torch.zeros(len(LENGTHS), 3, dtype=torch.long)
        gapped = TokenRows.join([TokenRows(gap, gap.bool()), rows])
        prompt = Prompt(changing.embed_tokens(gapped.ids), gapped.mask)
        written = recorded(prompt, embeds_SH, head_SH, 12).numbers.tolist()
        assert written == ours(changing, rows, SYMBOL_IDS, drafted=True)
        answers.append(written)
        for module in changing.vlm.model.text_model.modules():
            if isinstance(module, torch.nn.Linear):
                module.weight.mul_(1.5)
        layers.refresh()
    assert answers[0] != ours(changing, prompts(changing, 0, LENGTHS), SYMBOL_IDS, drafted=True)


# columns of a 2 x 2 image in nine tokens
IMAGE_COLUMNS = torch.arange(2, 6)


@pytest.fixture(params=["smolvlm", "paligemma", "qwen"])
def text(request: pytest.FixtureRequest) -> tuple[Any, Positions]:
    """A text model, and the positions that its family takes columns for."""
    nano = load_tokenizer(NANO)
    if request.param == "qwen":
        qwen = build_qwen(nano_qwen_config(nano), 56)
        return qwen.text_model, lambda column_C: qwen.positions(column_C, IMAGE_COLUMNS)
    if request.param == "smolvlm":
        return build_backbone(nano_config(nano)).text_model, same_positions
    paligemma = build_paligemma(nano_paligemma_config(nano))
    return paligemma.text_model, paligemma.positions


def nine_tokens(model: Any) -> tuple[Tensor, Tensor]:
    """Return the tokens' embeddings and columns, of three rows."""
    generator = torch.Generator().manual_seed(0)
    return torch.randn(3, 9, model.config.hidden_size, generator=generator), torch.arange(9).expand(3, 9)


@torch.no_grad()
def states_of_nine_tokens(model: Any, positions: Positions, *, compiled: bool = False) -> Tensor:
    """Compute the states of five tokens as a prompt, two as a pass, two singly."""
    embeds_BKH, columns_BK = nine_tokens(model)
    text = CachedText(TextLayers(model, compiled=compiled), 3, 20, positions)
    states = [text(embeds_BKH[:, part], columns_BK[:, part]) for part in (slice(5), slice(5, 7))]
    passes = zip(embeds_BKH[:, 7:].split(1, dim=1), text.singly(columns_BK[:, 7:]), strict=True)
    states += [text.read(embeds_B1H, columns) for embeds_B1H, columns in passes]
    return torch.cat(states, dim=1)


@torch.no_grad()
def test_fast_layers_compute_what_the_plain_ones_do_and_those_what_the_model_does(
    text: tuple[Any, Positions],
) -> None:
    """Copied weights that stand joined are rotated by halves, plain ones on a CPU by pairs."""
    model, positions = text
    for parameter in model.parameters():  # norms and biases that are not ones and zeros
        parameter += 0.1 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(1))
    embeds_BKH, columns_BK = nine_tokens(model)
    position_L = positions(torch.arange(9))
    plain = hidden_states(model, embeds_BKH, position_L)
    # (B, L), or (3, B, L) of Qwen2.5-VL
    own = model(inputs_embeds=embeds_BKH, position_ids=torch.stack(3 * [position_L], dim=-2))
    torch.testing.assert_close(plain, own.last_hidden_state, rtol=0, atol=1e-4)
    for layers in (TextLayers(model), TextLayers(model, copy_dtype=torch.float32)):
        states = CachedText(layers, 3, 20, positions)(embeds_BKH, columns_BK)
        torch.testing.assert_close(states, plain, rtol=0, atol=1e-4)


def states_of_stock(model: Any, embeds: Tensor, position_L: Tensor, attention_mask_BLL: Tensor) -> Tensor:
    """Return the states that transformers computes, with a mask of its own for each row."""
    mask = torch.zeros(attention_mask_BLL.shape).masked_fill(
        ~attention_mask_BLL, torch.finfo(torch.float32).min
    )[:, None]
    is_gemma = model.config.model_type.startswith("gemma2")
    return model(
        inputs_embeds=embeds,
        attention_mask={"full_attention": mask, "sliding_attention": mask} if is_gemma else mask,
        position_ids=torch.stack(len(embeds) * [position_L], dim=-2),
        use_cache=False,
    ).last_hidden_state


@torch.no_grad()
@pytest.mark.parametrize("copy_dtype", [None, torch.float32])
def test_a_hidden_token_is_read_by_no_other_and_keeps_its_position(
    text: tuple[Any, Positions], copy_dtype: torch.dtype | None
) -> None:
    model, positions = text
    embeds, columns = nine_tokens(model)
    hidden = torch.zeros(3, 9, dtype=torch.bool)
    hidden[0, 3] = hidden[1, 2] = hidden[1, 4] = True
    causal = torch.ones(3, 9, 9, dtype=torch.bool).tril()
    expected = states_of_stock(model, embeds, positions(torch.arange(9)), causal & ~hidden[:, None])
    cached = CachedText(TextLayers(model, copy_dtype=copy_dtype), 3, 20, positions)
    cached.hide(columns[:, :5], hidden[:, :5])
    states = [cached(embeds[:, part], columns[:, part]) for part in (slice(5), slice(5, 7))]
    states.append(cached.read(embeds[:, 7:8], *cached.singly(columns[:, 7:8])))
    torch.testing.assert_close(torch.cat(states, dim=1), expected[:, :8], rtol=0, atol=1e-4)
    cached.keep(torch.tensor([1]))
    last = cached(embeds[1:2, 8:], columns[1:2, 8:])
    torch.testing.assert_close(last, expected[1:2, 8:], rtol=0, atol=1e-4)
    cached.clear()
    plain = states_of_stock(model, embeds, positions(torch.arange(9)), causal)
    torch.testing.assert_close(cached(embeds[1:2], columns[1:2]), plain[1:2], rtol=0, atol=1e-4)


def test_singly_and_with_projections_that_are_not_plain_states_are_the_same(
    text: tuple[Any, Positions],
) -> None:
    """Check heads with a hook, as adapters have; such heads are turned another way."""
    model, positions = text
    states = states_of_nine_tokens(model, positions)
    together = CachedText(TextLayers(model), 3, 20, positions)
    with torch.no_grad():
        torch.testing.assert_close(together(*nine_tokens(model)), states, rtol=0, atol=1e-4)
    seen = []
    model.layers[1].self_attn.k_proj.register_forward_hook(lambda *_: seen.append(1))
    torch.testing.assert_close(states_of_nine_tokens(model, positions), states, rtol=0, atol=1e-4)
    assert len(seen) == 4


@pytest.mark.long
def test_compiled_layers_compute_the_same(text: tuple[Any, Positions]) -> None:
    compiled = states_of_nine_tokens(*text, compiled=True)
    torch.testing.assert_close(compiled, states_of_nine_tokens(*text), rtol=0, atol=1e-4)


@torch.no_grad()
def test_what_was_recorded_is_forgotten_when_the_model_gets_other_modules(backbone: SmolVLMBackbone) -> None:
    changing = copy.deepcopy(backbone)
    model: Any = changing.vlm.model.text_model
    recordings = GraphCache[CachedText](model)
    prompt_BLH = torch.zeros(1, 8, model.config.hidden_size)
    first = recordings.find(prompt_BLH, 4, lambda text: text)
    assert recordings.find(prompt_BLH, 4, lambda text: text) is first
    assert recordings.find(prompt_BLH, 5, lambda text: text) is not first
    model.layers[0].mlp = torch.nn.Sequential(model.layers[0].mlp)[0]
    assert recordings.find(prompt_BLH, 4, lambda text: text) is first  # the same modules
    model.layers[0].mlp = copy.deepcopy(model.layers[0].mlp)
    assert recordings.find(prompt_BLH, 4, lambda text: text) is not first
    assert not vars(copy.deepcopy(recordings))["_made"]


def test_an_answer_longer_than_the_models_positions_is_refused(backbone: SmolVLMBackbone) -> None:
    rows = prompts(backbone, 0, [30])
    with pytest.raises(
        ValueError, match=r"take 4097 tokens, and the model has 4096 positions; .* give a smaller"
    ):
        continuation(backbone, rows, 4067)
    continuation(backbone, rows, 4066)
