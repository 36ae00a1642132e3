"""``vla0_smol``: actions as integer text.

Sources: VLA-0 (arXiv 2510.13054) and the VLA-0-Smol recipe.

Shapes: `B` batch, `T` actions of a chunk, `D` action dims, `N` numbers of an answer, `C` columns a number
takes, `L` tokens of a sequence, `A` tokens of an answer, `H` hidden size, `P` tokens of an image.
"""

from functools import partial
from typing import Any

import torch
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION
from torch import Tensor
from torch.nn.functional import cross_entropy, pad

from lerobot_bomb.actions.accuracy import counted_numbers, exact_numbers, means, read_numbers
from lerobot_bomb.actions.bins import Bins
from lerobot_bomb.actions.relative import Statistics
from lerobot_bomb.actions.text import (
    END,
    IGNORED,
    NUM_SYMBOLS,
    SPACE,
    Answer,
    NumberTokens,
    TokenRows,
    digits_needed,
    draw_hidden,
    number_symbols,
)
from lerobot_bomb.bomb.pointing import PointedAt
from lerobot_bomb.checkpoints.adapters import peft_targets
from lerobot_bomb.decoding.decoder import Decoded, Prompt
from lerobot_bomb.decoding.draft import KnownSymbols, LinearDraft
from lerobot_bomb.decoding.grammar import NumberGrammar
from lerobot_bomb.decoding.kv_cache import check_positions
from lerobot_bomb.decoding.writer import NumberWriter
from lerobot_bomb.policies.pointing_policy import BOARD_READER, Parts, PointingVlaPolicy
from lerobot_bomb.policies.policy import RelativeVlaPolicy
from lerobot_bomb.policies.token_policy import TokenVlaPolicy
from lerobot_bomb.training.distributed import weighed
from lerobot_bomb.vlm.color_jitter import ColorJitter
from lerobot_bomb.vlm.images import crop, encode_images
from lerobot_bomb.vlm.inputs import read_actions, read_image
from lerobot_bomb.vlm.layout import STATE
from lerobot_bomb.vlm.prompt import TASK_TEMPLATE
from lerobot_policy_bomb.vla0_smol.building_vla0_smol import build_model, make_layout
from lerobot_policy_bomb.vla0_smol.card_vla0_smol import METHOD
from lerobot_policy_bomb.vla0_smol.configuration_vla0_smol import AS_TRAINED, SHAPES, Vla0SmolConfig
from lerobot_policy_bomb.vla0_smol.pointing_vla0_smol import NUM_NUMBERS, make_pointer
from lerobot_policy_bomb.vla0_smol.scored_vla0_smol import ScoredVla0Smol


class Vla0SmolPolicy(RelativeVlaPolicy, TokenVlaPolicy, PointingVlaPolicy):
    """A stock SmolVLM or Qwen2.5-VL that writes the next ``chunk_size`` actions as integers."""

    config_class = Vla0SmolConfig  # pyright: ignore[reportAssignmentType]  LeRobot annotates it as None
    name = "vla0_smol"  # pyright: ignore[reportAssignmentType]
    method = METHOD
    config: Vla0SmolConfig
    shapes, as_trained = SHAPES, AS_TRAINED
    symbol_ids: Tensor
    _fsdp_wrap_modules: list[str]

    def __init__(
        self, config: Vla0SmolConfig, dataset_meta: LeRobotDatasetMetadata | None = None, **_: object
    ):
        super().__init__(config, dataset_meta)
        if dataset_meta is not None:
            config.check_masking()
        self.pointer = make_pointer(config, dataset_meta)
        # numbers of an answer before those of its actions
        self._num_pointing = 0 if self.pointer is None else NUM_NUMBERS
        self.tokens, self.backbone = build_model(config)
        # modules that FSDP shards one by one; accelerate reads the second name, LeRobot 0.6.2 the class's
        sharded = sorted({type(layer).__name__ for layer in self.backbone.layers})
        self._fsdp_wrap_modules = self._no_split_modules = type(self)._fsdp_wrap_modules = sharded
        self.register_buffer("symbol_ids", torch.tensor(self.tokens.symbols), persistent=False)
        self.action_bins = Bins(config.n_action_bins, config.bin_mode)
        self.state_bins = Bins(config.n_state_bins, config.bin_mode)
        self.grammar = NumberGrammar(
            config.n_action_bins, self._num_numbers(config.chunk_size), fixed_width=config.number_width
        )
        self.layout = make_layout(config, self.tokens, self._cameras, self.backbone.tokens_per_image)
        num_fixed = self.layout.num_tokens + self.grammar.max_symbols(self.grammar.num_numbers)
        self._check_length(self.backbone.text_config, num_fixed, TASK_TEMPLATE, dataset_meta)
        guess = (
            KnownSymbols(self.grammar)
            if config.draft == "none"
            else LinearDraft(self.grammar, self.action_dim, self._num_pointing)
        )
        columns = self.layout.image_columns(torch.device("cpu"))
        # of a prompt's and its answer's columns, the same in every row
        self._positions = partial(self.backbone.positions, image_columns=columns)
        self._writer = NumberWriter(
            self.backbone, self.grammar, guess, self._positions, compiled=config.compile_model
        )
        self._add_board_reader(self.backbone.text_config.hidden_size, self.backbone.tokens_per_image)
        self._color_jitter = None if config.color_jitter is None else ColorJitter(*config.color_jitter)
        self._ensemble = self._make_ensemble()
        self._decoded: Decoded | None = None  # in the last prediction
        self.reset()

    def _start_on(self, meta: LeRobotDatasetMetadata, actions: Statistics) -> None:
        super()._start_on(meta, actions)
        if self.pointer is not None:
            self.pointer.check(meta, self.config)

    def _fit(self, meta: LeRobotDatasetMetadata) -> None:
        super()._fit(meta)
        if self.pointer is not None:
            self.pointer.fit_units(meta, self.config.normalization_mapping)

    def _num_numbers(self, num_steps: int) -> int:
        """Count the numbers of an answer with this many actions."""
        return self._num_pointing + num_steps * self.action_dim

    def scored(self) -> ScoredVla0Smol:
        """Return the policy as `lerobot_bomb.explain` scores its answers."""
        return ScoredVla0Smol(self)

    def _get_default_peft_targets(self) -> dict[str, Any]:
        return peft_targets(self, self.backbone.text_model_name, ("pointer", BOARD_READER))

    # Training

    def forward(self, batch: dict[str, Tensor], reduction: str = "mean") -> tuple[Tensor, dict[str, float]]:
        """Return the answer's cross-entropy over the loss mask; ``reduction="none"`` gives (B,)."""
        if reduction not in ("mean", "none"):
            raise ValueError(f"reduction={reduction!r} is unknown; choose mean or none")
        self._begin_batch()
        with self.autocast():
            prompt = self.prompt(batch)
            bins_BN, loss_mask_BN = self._targets(batch)
            numbers = self._numbers(bins_BN, loss_mask_BN)
            answer = self._answer(numbers)
            features_BPH = self.encode_images(batch)
            logits_BAV = self._answer_logits(features_BPH, prompt, answer.rows)
        loss_mask_BA = answer.labels != IGNORED
        losses_BA = cross_entropy(
            logits_BAV.float().flatten(0, 1), answer.labels.flatten(), ignore_index=IGNORED, reduction="none"
        ).view_as(answer.labels)
        weighted_BA = self.config.pointing_loss_weight * losses_BA
        losses_BA = torch.where(self._is_pointing(answer, numbers), weighted_BA, losses_BA)
        if reduction == "none":
            loss = losses_BA.sum(dim=1) / loss_mask_BA.sum(dim=1).clamp(min=1)
        else:
            loss = losses_BA.sum() / loss_mask_BA.sum().clamp(min=1)
            loss = weighed(loss, loss_mask_BA) if self.training else loss
        loss, board = self._with_board(loss, batch, features_BPH)
        parts = self._metric_parts(logits_BAV.detach(), answer, numbers, bins_BN) | board
        return loss, means(parts, loss, self.config.trained_batches)

    def _is_pointing(self, answer: Answer, numbers: NumberTokens) -> Tensor:
        """Return (B, A) bool, the tokens of an answer that are of pointing and not of actions."""
        return answer.columns < self._num_pointing * numbers.mask.shape[2]

    @torch.no_grad()
    def _metric_parts(
        self, logits_BAV: Tensor, answer: Answer, numbers: NumberTokens, bins_BN: Tensor
    ) -> Parts:
        """Return right tokens, exact numbers and absolute errors in the data's units, as `means` takes them.

        Teacher-forced: every digit is predicted from the true ones before it. Hidden and padded numbers do
        not count. Errors are known only with a dataset, that is in training.
        """
        before = self._num_pointing
        loss_mask_BA = (answer.labels != IGNORED) & ~self._is_pointing(answer, numbers)
        right_BA = logits_BAV.argmax(dim=-1) == answer.labels
        digits_BA = logits_BAV[..., self.symbol_ids[:SPACE]].argmax(dim=-1)
        read_BN = read_numbers(numbers, answer.with_padding(digits_BA, numbers))
        exact_BN = exact_numbers(numbers, answer.with_padding(right_BA, numbers))
        counted_BN = counted_numbers(numbers)
        bins, actions = self.action_bins, slice(before, None)
        errors_BN = (bins.decode(read_BN.clamp(max=bins.num_bins - 1)) - bins.decode(bins_BN)).abs()
        errors_BTD = errors_BN[:, actions].unflatten(1, (-1, self.action_dim)) * self._unit
        counted_BTD = counted_BN[:, actions].view_as(errors_BTD)
        parts = {
            "token_accuracy": (right_BA, loss_mask_BA),
            "value_accuracy": (exact_BN[:, actions], counted_BN[:, actions]),
        }
        parts |= self._l1_parts(errors_BTD, counted_BTD)
        if self.pointer is not None:
            parts |= self.pointer.error_parts(errors_BN[:, :before], counted_BN[:, :before])
        return parts

    def _answer_logits(self, features_BPH: Tensor, prompt: TokenRows, answer: TokenRows) -> Tensor:
        """Teacher-forced logits of every answer token: (B, A, V)."""
        return self.backbone.logits(self._answer_hidden(features_BPH, prompt, answer))

    def _answer_hidden(self, features_BPH: Tensor, prompt: TokenRows, answer: TokenRows) -> Tensor:
        """Teacher-forced states that predict every answer token: (B, A, H)."""
        rows = TokenRows.join([prompt, answer]).without_padding()
        ids_BL = rows.ids
        check_positions(self.backbone.text_config, ids_BL.shape[1])
        hidden_BLH = self.backbone.hidden_states(
            self.embed(ids_BL, features_BPH), self.layout.image_columns(ids_BL.device), rows.hidden
        )
        offsets_A = torch.arange(answer.ids.shape[1], device=ids_BL.device)
        # a token is predicted one column earlier; columns beyond a short row carry no label
        columns_BA = prompt.mask.sum(dim=1, keepdim=True) - 1 + offsets_A
        columns_BA = columns_BA.clamp(max=ids_BL.shape[1] - 1)
        index_BAH = columns_BA[..., None].expand(-1, -1, hidden_BLH.shape[-1])
        return hidden_BLH.gather(1, index_BAH)

    def log_probability(self, features_BPH: Tensor, prompt: TokenRows, numbers_BN: Tensor) -> Tensor:
        """Return log-probabilities (B,) of numbers under the grammar, after prompts and their images."""
        written = self._answer(self._to_tokens(numbers_BN, self.config.n_action_bins)).rows
        hidden_BAH = self._answer_hidden(features_BPH, prompt, written)
        logits_BAS = self.backbone.head(self.symbol_ids)(hidden_BAH)
        symbol_BA = (written.ids[..., None] == self.symbol_ids).long().argmax(dim=-1)
        # the space that every answer begins with is not chosen
        places = self.grammar.walk(self.grammar.start(len(symbol_BA)), symbol_BA[:, 1:-1])
        logits_BAS = logits_BAS[:, 1:].float() + self.grammar.logit_bias(places)
        chosen_BA1 = logits_BAS.log_softmax(dim=-1).gather(-1, symbol_BA[:, 1:, None])
        return chosen_BA1.sum(dim=(1, 2))

    def _targets(self, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Return the bins to write, (B, N) int64, actions step by step, and the loss mask, (B, N) bool."""
        shape = self.config.chunk_size, self.action_dim
        actions_BTD = read_actions(batch, ACTION, self.config.type, self._device, shape)
        actions_BTD, loss_mask_BT = self.to_relative(actions_BTD, batch), self._loss_mask(batch)
        if self.pointer is None:
            return self._action_targets(actions_BTD, loss_mask_BT)
        labels = self.pointer.labels(batch, self._other_share, self.config.type, self.generator)
        other_B1D = self.to_relative(labels.other_actions[:, None], batch)
        targets = self._action_targets(*labels.given_actions(actions_BTD, loss_mask_BT, other_B1D))
        pointing = self.pointer.bins_of(labels, self._state(batch)), self.pointer.loss_mask(labels)
        bins_BN, loss_mask_BN = (torch.cat(pair, dim=1) for pair in zip(pointing, targets, strict=True))
        return bins_BN, loss_mask_BN

    def _action_targets(self, actions_BTD: Tensor, loss_mask_BT: Tensor) -> tuple[Tensor, Tensor]:
        """Targets of the actions alone, all dimensions."""
        bins_BN = self.action_bins.encode(actions_BTD).flatten(1)
        return bins_BN, loss_mask_BT.repeat_interleave(self.action_dim, dim=1)

    def _numbers(self, bins_BN: Tensor, loss_mask_BN: Tensor) -> NumberTokens:
        """Bins -> their tokens, some of them hidden while training."""
        numbers = self._to_tokens(bins_BN, self.config.n_action_bins)
        loss_mask_BNC = numbers.loss_mask & loss_mask_BN[..., None]
        # the space after a number says that it ends
        before = self._num_pointing
        loss_mask_BNC[:, 1 : before + 1, 0] = loss_mask_BN[:, :before]
        numbers = NumberTokens(numbers.ids, numbers.mask, loss_mask_BNC)
        return self._hide(numbers) if self.training else numbers

    def _hide(self, numbers: NumberTokens) -> NumberTokens:
        """Hide random numbers, steps or characters of actions from the model."""
        level = self.config.mask_level
        mask_BNC = numbers.mask[:, self._num_pointing :]
        if level == "char":
            hidden_BNC = self._draw_hidden(mask_BNC.flatten(1)).view_as(mask_BNC)
            hidden_BNC = pad(hidden_BNC, (0, 0, self._num_pointing, 0))
            return numbers.hide_characters(hidden_BNC, self.tokens.hidden)
        if level == "step":
            hidden_BT = self._draw_hidden(mask_BNC[:, :: self.action_dim, 0])
            hidden_BN = hidden_BT.repeat_interleave(self.action_dim, dim=1)
        else:
            hidden_BN = self._draw_hidden(mask_BNC[..., 0])
        return numbers.hide_numbers(pad(hidden_BN, (self._num_pointing, 0)), self.tokens.hidden)

    def _draw_hidden(self, eligible_BM: Tensor) -> Tensor:
        config = self.config
        return draw_hidden(eligible_BM, config.mask_max_fraction, config.mask_skip_prob, self.generator)

    def _answer(self, numbers: NumberTokens) -> Answer:
        return Answer.of(numbers, self.symbol_ids[END])

    # Inference

    def _predict(self, batch: dict[str, Tensor], num_steps: int) -> Tensor:
        """Return the chunk's first ``num_steps`` actions, absolute; the model need not write the rest."""
        numbers_BN = self.write(batch, num_steps)[:, self._num_pointing :]
        actions_BTD = self.action_bins.decode(numbers_BN).view(-1, num_steps, self.action_dim)
        return self.to_absolute(actions_BTD, batch).clamp(-1, 1)

    @torch.no_grad()
    def write(self, batch: dict[str, Tensor], num_steps: int) -> Tensor:
        """Write numbers (B, N): those of pointing, then those of the actions."""
        self.eval()
        with self.autocast():
            prompt = self.prompt(batch)
            if not prompt.ids.is_cuda:  # there, prompts of each length would be captured anew
                prompt = prompt.without_padding()
            embeds_BLH = self.embed(prompt.ids, self.encode_images(batch))
            num_numbers = self._num_numbers(num_steps)
            noise_shape = self.grammar.max_symbols(num_numbers), NUM_SYMBOLS
            self._decoded = decoded = self._writer(
                Prompt(embeds_BLH, prompt.mask, prompt.hidden),
                self.symbol_ids,
                num_numbers,
                self._choice_noise(len(embeds_BLH), noise_shape),
            )
        # casts of weights cached under inference mode cannot be used by a later training step
        torch.clear_autocast_cache()
        return decoded.numbers

    def pointed(self, batch: dict[str, Tensor]) -> PointedAt | None:
        """Return what the policy points at in a batch of one row; None if it does not point."""
        if self.pointer is None:
            return None
        return self.pointer.pointed_at(self.write(batch, self.config.chunk_size)[0, :NUM_NUMBERS])

    @property
    def last_passes(self) -> int | None:
        """Passes of the text model in the last prediction, the prompt's included; None if there was none."""
        return None if self._decoded is None else self._decoded.num_passes

    @property
    def last_tokens(self) -> float | None:
        """Spaces and digits of the last prediction, the mean over its rows; None if there was none."""
        if self._decoded is None:
            return None
        written = self._to_tokens(self._decoded.numbers, self.config.n_action_bins).mask
        return float(written.sum()) / len(written)

    # Prompt

    def _prompt_rows(self, batch: dict[str, Tensor]) -> dict[str, TokenRows]:
        if not self.config.use_state:
            return {}
        state = self._to_tokens(self.state_bins.encode(self._state(batch)), self.config.n_state_bins)
        return {STATE: TokenRows(state.ids.flatten(1), state.mask.flatten(1))}

    def _to_tokens(self, numbers_BN: Tensor, num_values: int) -> NumberTokens:
        fixed_width = self.config.number_width
        symbols_BNC, mask_BNC = number_symbols(
            numbers_BN, fixed_width or digits_needed(num_values), zero_padded=fixed_width > 0
        )
        return NumberTokens(self.symbol_ids[symbols_BNC], mask_BNC, mask_BNC)

    def encode_images(self, batch: dict[str, Tensor]) -> Tensor:
        """Return image features (B, P of all images, H)."""
        generator = self.generator if self.training else None
        images = [read_image(batch, key, self.config.type, self._device) for key in self._cameras]
        images = [crop(image, self.config.crop_fraction, generator) for image in images]
        if generator is not None and self._color_jitter is not None:
            images = self._color_jitter(images, generator)
        return encode_images(self.backbone, images)

    def embed(self, ids_BL: Tensor, features_BPH: Tensor) -> Tensor:
        """Embed a sequence that starts with a prompt, (B, L, H), image features in place."""
        return self.layout.with_images(self.backbone.embed_tokens(ids_BL), features_BPH)
