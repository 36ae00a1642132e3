"""Base models of other families: each is read, trained and decoded as its stock class would do it."""

import copy
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from backbone_folders import (
    QWEN_IMAGE_SIZE,
    answer_text,
    is_qwen,
    options_of,
    prompt_text,
    small_model,
    stock_inputs,
    write_folder,
)
from grammar_processor import GrammarProcessor
from lerobot.policies.factory import make_pre_post_processors
from torch import Tensor
from vla0_smol_cases import STATS, WORKSPACE, WRIST, make_batch, make_policy, numbers_of, raw_batch, sequence

from lerobot_bomb.actions.text import END, SPACE
from lerobot_bomb.commands.main import main
from lerobot_bomb.decoding.decoder import Prompt, decode_numbers
from lerobot_bomb.decoding.decoder_layers import TextLayers
from lerobot_bomb.decoding.draft import KnownSymbols, LinearDraft
from lerobot_bomb.decoding.graph_decoder import GraphDecoder
from lerobot_bomb.decoding.kv_cache import CachedText
from lerobot_bomb.decoding.writer import continue_prompt
from lerobot_bomb.vlm.tokenizer import load_tokenizer
from lerobot_policy_bomb.vla0_smol import make_vla0_smol_pre_post_processors
from lerobot_policy_bomb.vla0_smol.modeling_vla0_smol import Vla0SmolPolicy

Batch = dict[str, Any]


# idefics3 is read as smolvlm is
@pytest.fixture(
    scope="module", params=["smolvlm", pytest.param("idefics3", marks=pytest.mark.long), "qwen2_5_vl"]
)
def family(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="module")
def folder(family: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_folder(family, tmp_path_factory.mktemp(family))


def policy_of(folder: Path, family: str, **options: Any) -> Vla0SmolPolicy:
    """Make a policy that sees whole images, whose size the batches below have, and hides nothing."""
    fixed: dict[str, Any] = {"crop_fraction": 1.0, "mask_max_fraction": 0.0}
    return make_policy(vlm_model_name=str(folder), **{**fixed, **options_of(family), **options})


@pytest.fixture(scope="module")
def policy(folder: Path, family: str) -> Vla0SmolPolicy:
    return policy_of(folder, family)


def own_size_batch(policy: Vla0SmolPolicy, batch_size: int, seed: int = 0) -> Batch:
    """Images as the vision model reads them: of its size, in levels."""
    batch = make_batch(policy, batch_size, seed)
    generator = torch.Generator().manual_seed(seed)
    shape = batch_size, 3, policy.backbone.image_size, policy.backbone.image_size
    for key in (WORKSPACE, WRIST):
        batch[key] = torch.randint(0, 256, shape, generator=generator) / 255
    return batch


def images_of(batch: Batch, row: int) -> Tensor:
    return torch.stack([batch[key][row] for key in (WORKSPACE, WRIST)])


def texts_of(policy: Vla0SmolPolicy, batch: Batch, row: int) -> tuple[str, str]:
    state = policy.state_bins.encode(batch["observation.state"][row]).tolist()
    numbers = policy.action_bins.encode(batch["action"][row]).flatten().tolist()
    task = raw_batch(len(batch["action"]))["task"][row]
    state = state if policy.config.use_state else None
    return prompt_text(policy, task, state), answer_text(policy, numbers)


# Sequence


@pytest.mark.parametrize("system_prompt", [None, "Write numbers, 0 to 511.\nBe precise."])
@pytest.mark.parametrize("use_state", [True, False])
def test_the_sequence_is_the_whole_string_tokenized(
    folder: Path, family: str, system_prompt: str | None, use_state: bool
) -> None:
    policy = policy_of(folder, family, system_prompt=system_prompt, use_state=use_state)
    batch, tokenizer = make_batch(policy, 3), load_tokenizer(str(folder))
    for row, ids in enumerate(sequence(policy, batch)):
        assert ids == tokenizer.encode("".join(texts_of(policy, batch, row))).ids


# The stock model


def test_a_folders_own_class_and_weights_are_loaded(
    policy: Vla0SmolPolicy, folder: Path, family: str
) -> None:
    model_class = type(small_model(family, load_tokenizer(str(folder))))
    assert type(policy.backbone.vlm) is model_class
    for name, parameter in model_class.from_pretrained(folder).named_parameters():
        assert torch.equal(policy.backbone.vlm.get_parameter(name), parameter), name
    assert json.loads((folder / "config.json").read_text())["model_type"] == family


@torch.no_grad()
def test_logits_are_the_stock_models_images_and_positions_included(policy: Vla0SmolPolicy) -> None:
    batch = own_size_batch(policy, 3)
    answer = policy._answer(numbers_of(policy, batch)).rows
    logits = policy._answer_logits(policy.encode_images(batch), policy.prompt(batch), answer)
    for row, ids in enumerate(sequence(policy, batch)):
        inputs = stock_inputs(policy, torch.tensor(ids), images_of(batch, row))
        expected = policy.backbone.vlm(**inputs).logits[0]
        length = int(answer.mask[row].sum())
        torch.testing.assert_close(logits[row, :length], expected[-length - 1 : -1], rtol=0, atol=1e-5)
        other = stock_inputs(policy, torch.tensor(ids), images_of(batch, row).flip(0))
        assert not torch.allclose(policy.backbone.vlm(**other).logits[0], expected, atol=1e-3)


@torch.no_grad()
def test_it_writes_what_generate_writes(policy: Vla0SmolPolicy) -> None:
    """Transformers' own greedy search with its own cache, under the same grammar."""
    batch = own_size_batch(policy, 4, seed=1)
    prompt = policy.prompt(batch)
    written = policy.action_bins.encode(policy.predict_action_chunk(batch)).flatten(1).tolist()
    space, end_id = policy.symbol_ids[SPACE : SPACE + 1], int(policy.symbol_ids[END])
    for row in range(4):
        ids = torch.cat([prompt.ids[row, prompt.mask[row]], space])
        processor = GrammarProcessor(policy.config.n_action_bins, 12, len(ids), policy.symbol_ids)
        generated = policy.backbone.vlm.generate(
            **stock_inputs(policy, ids, images_of(batch, row)),
            max_new_tokens=12 * 4,
            do_sample=False,
            logits_processor=[processor],
            eos_token_id=end_id,
            pad_token_id=end_id,
        )
        assert processor.read(generated) == [written[row]]
    assert len(set(map(tuple, written))) > 1


# Decoding


@torch.no_grad()
def test_the_cache_gives_the_logits_of_a_full_pass(policy: Vla0SmolPolicy) -> None:
    """Rows of different lengths; the answer in pieces, one of which is written over."""
    batch = own_size_batch(policy, 2)
    prompt, numbers = policy.prompt(batch).without_padding(), numbers_of(policy, batch)
    answer = policy._answer(numbers).rows
    full = policy._answer_logits(policy.encode_images(batch), prompt, answer)[..., policy.symbol_ids]
    said = (answer.ids[..., None] == policy.symbol_ids).long().argmax(dim=-1)
    embeds = policy.embed(prompt.ids, policy.encode_images(batch))
    model = continue_prompt(
        policy.backbone, Prompt(embeds, prompt.mask), policy.symbol_ids, 60, policy._positions
    )
    first = torch.zeros(2, dtype=torch.int64)
    model(torch.cat([said[:, :3], 9 - said[:, 3:5]], dim=1), first)  # wrong guesses
    cached = torch.cat([model(said[:, 2:6], first + 2), model(said[:, 6:9], first + 6)], dim=1)
    torch.testing.assert_close(cached, full[:, 3:10], rtol=0, atol=1e-5)


def test_a_draft_changes_no_action(policy: Vla0SmolPolicy, folder: Path, family: str) -> None:
    undrafted = policy_of(folder, family, draft="none")
    batch = own_size_batch(policy, 4, seed=2)
    assert torch.equal(undrafted.predict_action_chunk(batch), policy.predict_action_chunk(batch))


def test_a_rows_actions_do_not_depend_on_the_batch(policy: Vla0SmolPolicy) -> None:
    batch = own_size_batch(policy, 4, seed=3)
    together = policy.predict_action_chunk(batch)
    assert len({len(text) for text in batch["task"]}) > 1
    for row in range(4):
        alone: Batch = {
            key: value[row : row + 1] if isinstance(value, Tensor | list) else value
            for key, value in batch.items()
        }
        assert torch.equal(policy.predict_action_chunk(alone)[0], together[row])


@torch.no_grad()
def test_on_a_copy_with_padding_it_writes_the_same(policy: Vla0SmolPolicy) -> None:
    """The way that is recorded on CUDA, pass by pass."""
    batch = own_size_batch(policy, 3, seed=4)
    expected = policy.action_bins.encode(policy.predict_action_chunk(batch)).flatten(1)
    prompt, backbone, grammar = policy.prompt(batch), policy.backbone, policy.grammar
    assert not prompt.mask.all()
    layers = TextLayers(backbone.text_model, copy_dtype=torch.float32)
    num_columns = prompt.ids.shape[1] + grammar.max_symbols(12)
    text = CachedText(layers, 3, num_columns, policy._positions)
    rows = backbone.embed_tokens(policy.symbol_ids), backbone.vlm.lm_head.weight[policy.symbol_ids]
    recorded = GraphDecoder(grammar, LinearDraft(grammar, 4), *rows, text)
    written = recorded(Prompt(policy.embed(prompt.ids, policy.encode_images(batch)), prompt.mask), *rows, 12)
    assert torch.equal(written.numbers, expected)
    plain = decode_numbers(
        continue_prompt(
            backbone,
            Prompt(policy.embed(prompt.ids, policy.encode_images(batch)), prompt.mask),
            policy.symbol_ids,
            grammar.max_symbols(12),
            policy._positions,
        ),
        grammar,
        KnownSymbols(grammar),
        batch_size=3,
        stop_after=12,
    )
    assert torch.equal(plain.numbers, expected)


# Training and checkpoints


def test_what_was_learned_by_heart_is_decoded(folder: Path, family: str) -> None:
    policy = policy_of(folder, family, chunk_size=2, n_action_bins=100).train()
    batch = own_size_batch(policy, 3)
    batch |= {"action": batch["action"][:, :2], "action_is_pad": batch["action_is_pad"][:, :2]}
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=2e-3, weight_decay=0.0)
    losses = []
    for _ in range(300):
        loss, metrics = policy(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
        if losses[-1] < 0.02 and metrics["token_accuracy"] == 1.0:
            break
    assert losses[-1] < 0.05 < losses[0]
    trained = policy.action_bins.decode(policy.action_bins.encode(batch["action"]))
    assert torch.equal(policy.predict_action_chunk(batch), trained)


def test_a_checkpoint_needs_no_base_folder(folder: Path, family: str, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path / "base")
    policy = policy_of(tmp_path / "base", family, system_prompt="Be precise.")
    batch = own_size_batch(policy, 2)
    policy.save_pretrained(tmp_path / "model")
    for pipeline in make_vla0_smol_pre_post_processors(policy.config, STATS):
        pipeline.save_pretrained(tmp_path / "model")
    shutil.rmtree(tmp_path / "base")
    loaded = Vla0SmolPolicy.from_pretrained(tmp_path / "model")
    assert type(loaded.backbone.vlm) is type(policy.backbone.vlm)
    assert torch.equal(loaded.predict_action_chunk(batch), policy.predict_action_chunk(batch))
    preprocessor, _ = make_pre_post_processors(loaded.config, str(tmp_path / "model"))
    again, once = preprocessor(raw_batch(2)), make_batch_of(policy, tmp_path / "model")
    assert torch.equal(loaded.prompt(again).ids, policy.prompt(once).ids)


def make_batch_of(policy: Vla0SmolPolicy, checkpoint: Path) -> Batch:
    preprocessor, _ = make_pre_post_processors(policy.config, str(checkpoint))
    return preprocessor(raw_batch(2))


def test_an_exported_backbone_starts_another_policy(folder: Path, family: str, tmp_path: Path) -> None:
    policy = policy_of(folder, family)
    policy.save_pretrained(tmp_path / "model")
    for pipeline in make_vla0_smol_pre_post_processors(policy.config, STATS):
        pipeline.save_pretrained(tmp_path / "model")
    arguments = [f"--policy.path={tmp_path / 'model'}", f"--output={tmp_path / 'base'}"]
    assert main(["checkpoint", "export-backbone", *arguments]) == 0
    again = policy_of(tmp_path / "base", family)
    batch = own_size_batch(policy, 2)
    assert torch.equal(again.predict_action_chunk(batch), policy.predict_action_chunk(batch))


def test_adapters_go_to_every_projection_of_the_text_model(folder: Path, family: str) -> None:
    pytest.importorskip("peft")
    policy = policy_of(folder, family)
    policy.config.pretrained_path = Path("base")
    batch = own_size_batch(policy, 2)
    plain = policy.predict_action_chunk(batch)
    wrapped: Any = copy.deepcopy(policy).wrap_with_peft(peft_cli_overrides={"method_type": "LORA", "r": 4})
    trained = [name for name, parameter in wrapped.named_parameters() if parameter.requires_grad]
    assert sum("lora_A" in name for name in trained) == 7 * policy.backbone.text_config.num_hidden_layers
    assert all(f".{policy.backbone.text_model_name}.layers." in name for name in trained)
    with torch.no_grad():
        for name, parameter in wrapped.named_parameters():
            if "lora_B" in name:
                parameter += 0.3 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(0))
    actions = wrapped.eval().predict_action_chunk(batch)
    assert not torch.equal(actions, plain)
    merged = wrapped.merge_and_unload()
    torch.testing.assert_close(merged.predict_action_chunk(batch), actions, atol=1e-4, rtol=0)


def test_a_frozen_vision_encoder_leaves_the_connector(folder: Path, family: str) -> None:
    policy = policy_of(folder, family, freeze_vision_encoder=True).train()
    policy(own_size_batch(policy, 2))[0].backward()
    model = policy.backbone.vlm.model
    vision = model.visual if is_qwen(policy) else model.vision_model
    connector = set((vision.merger if is_qwen(policy) else model.connector).parameters())
    assert connector and all(parameter.grad is not None for parameter in connector)
    frozen = set(vision.parameters()) - connector
    assert frozen and all(parameter.grad is None for parameter in frozen)
    assert not frozen & set(policy.get_optim_params())


def test_gradient_checkpointing_changes_no_gradient(folder: Path, family: str) -> None:
    gradients = []
    for checkpointing in (False, True):
        policy = policy_of(folder, family, gradient_checkpointing=checkpointing).train()
        policy(own_size_batch(policy, 2))[0].backward()
        gradients.append({name: parameter.grad for name, parameter in policy.named_parameters()})
    assert gradients[0].keys() == gradients[1].keys()
    for name, gradient in gradients[0].items():
        torch.testing.assert_close(gradient, gradients[1][name], msg=name)


def test_fsdp_shards_every_layer_by_itself(policy: Vla0SmolPolicy) -> None:
    stacks = {
        type(block).__name__
        for module in policy.backbone.modules()
        if isinstance(module, torch.nn.ModuleList)
        for block in module
    }
    assert set(policy._no_split_modules) == set(policy._fsdp_wrap_modules) == stacks


# Refusals


def test_a_qwen_reads_images_of_224_pixels_unless_told_otherwise(tmp_path: Path) -> None:
    folder = write_folder("qwen2_5_vl", tmp_path)
    assert make_policy(vlm_model_name=str(folder)).backbone.tokens_per_image == 64
    assert make_policy(vlm_model_name=str(folder), image_size=140).backbone.tokens_per_image == 25
    (tmp_path / "model.safetensors").unlink()  # refused before the weights are read
    with pytest.raises(ValueError, match=r"--policy.image_size=100 must be a multiple of 28 pixels"):
        make_policy(vlm_model_name=str(folder), image_size=100)


def test_the_image_size_belongs_to_the_checkpoint(tmp_path: Path) -> None:
    policy = policy_of(write_folder("qwen2_5_vl", tmp_path / "base"), "qwen2_5_vl")
    policy.save_pretrained(tmp_path / "model")
    loaded = Vla0SmolPolicy.from_pretrained(tmp_path / "model")
    assert loaded.backbone.image_size == QWEN_IMAGE_SIZE
    loaded.config.image_size = 112
    with pytest.raises(ValueError, match=r"--policy.image_size=112: this checkpoint was trained with 56"):
        Vla0SmolPolicy.from_pretrained(tmp_path / "model", config=loaded.config)


@pytest.mark.parametrize(("name", "own"), [("nano", 128), ("smolvlm", 128), ("idefics3", 86)])
def test_another_image_size_of_a_smolvlm_is_refused(name: str, own: int, tmp_path: Path) -> None:
    name = name if name == "nano" else str(write_folder(name, tmp_path))
    assert make_policy(vlm_model_name=name, image_size=own).backbone.image_size == own
    message = rf"--policy.image_size=112: this SmolVLM .* images of {own} pixels .*; leave the flag out"
    with pytest.raises(ValueError, match=message):
        make_policy(vlm_model_name=name, image_size=112)


def test_other_families_are_refused_with_those_that_are_taken(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text('{"model_type": "qwen2_vl"}')
    message = r"is a 'qwen2_vl' model; this policy needs a 'smolvlm' or 'idefics3' or 'qwen2_5_vl' one"
    with pytest.raises(ValueError, match=message):
        make_policy(vlm_model_name=str(tmp_path))
