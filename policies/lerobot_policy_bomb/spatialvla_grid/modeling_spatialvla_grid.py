"""``spatialvla_grid``: actions as cells of adaptive grids.

Sources: SpatialVLA (arXiv 2501.15830); PaliGemma 2 (arXiv 2412.03555).

Shapes: `B` batch, `T` actions of a chunk, `D` action dims, `G` groups of them, `N` tokens that point (none
unless the config says so), `S` = N + T * G slots of an answer, `L` tokens of a prompt, `X` of a prompt and an
answer, `H` hidden size, `P` tokens of an image, `C` cells of a group.
"""

import logging
from pathlib import Path
from typing import Any, ClassVar

import torch
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION, OBS_IMAGES
from torch import Tensor, nn
from torch.nn.functional import cross_entropy, linear, pad

from lerobot_bomb.actions.accuracy import means
from lerobot_bomb.actions.bins import Bins
from lerobot_bomb.actions.grid_report import edges_text
from lerobot_bomb.actions.grid_rows import interpolate_rows
from lerobot_bomb.actions.grids import ActionGrids
from lerobot_bomb.actions.relative import Statistics
from lerobot_bomb.actions.text import TokenRows, digits_needed, number_symbols
from lerobot_bomb.bomb.pointing import PointedAt
from lerobot_bomb.checkpoints.adapters import peft_targets
from lerobot_bomb.checkpoints.checks import holds_module
from lerobot_bomb.data.columns import dim_names
from lerobot_bomb.decoding.decoder import Prompt
from lerobot_bomb.decoding.slots import SlotDecoder
from lerobot_bomb.policies.pointing_policy import BOARD_READER, PointingVlaPolicy
from lerobot_bomb.policies.token_policy import TokenVlaPolicy
from lerobot_bomb.training.distributed import weighed
from lerobot_bomb.vlm.depth import load_zoedepth
from lerobot_bomb.vlm.ego3d import Ego3D
from lerobot_bomb.vlm.images import draw_windows, resized_pixels
from lerobot_bomb.vlm.inputs import read_actions, read_image
from lerobot_bomb.vlm.layout import STATE
from lerobot_policy_bomb.spatialvla_grid.building_spatialvla_grid import (
    CELL_TABLES,
    adapted_layers,
    build_depth,
    build_model,
    check_adapted_cells,
    complete_depth,
    fit_to_data,
    make_grids,
    make_layout,
)
from lerobot_policy_bomb.spatialvla_grid.card_spatialvla_grid import METHOD
from lerobot_policy_bomb.spatialvla_grid.configuration_spatialvla_grid import (
    AS_TRAINED,
    NUM_STATE_BINS,
    SHAPES,
    SpatialvlaGridConfig,
)
from lerobot_policy_bomb.spatialvla_grid.pointing_spatialvla_grid import Target, make_pointer
from lerobot_policy_bomb.spatialvla_grid.points_spatialvla_grid import camera_points
from lerobot_policy_bomb.spatialvla_grid.scored_spatialvla_grid import ScoredSpatialvlaGrid

logger = logging.getLogger(__name__)


class SpatialvlaGridPolicy(TokenVlaPolicy, PointingVlaPolicy):
    """A PaliGemma 2 that chooses the next ``chunk_size`` actions, one cell of each grid a step."""

    config_class = SpatialvlaGridConfig  # pyright: ignore[reportAssignmentType]  LeRobot annotates it as None
    name = "spatialvla_grid"  # pyright: ignore[reportAssignmentType]
    method = METHOD
    config: SpatialvlaGridConfig
    shapes, as_trained = SHAPES, AS_TRAINED
    symbol_ids: Tensor
    # modules that FSDP shards one by one; accelerate reads the second name
    _fsdp_wrap_modules: ClassVar[list[str]] = ["Gemma2DecoderLayer", "SiglipEncoderLayer"]
    _no_split_modules = _fsdp_wrap_modules

    def __init__(
        self, config: SpatialvlaGridConfig, dataset_meta: LeRobotDatasetMetadata | None = None, **_: object
    ):
        super().__init__(config, dataset_meta)
        self.pointer = make_pointer(config, dataset_meta)
        self.tokens, self.backbone = build_model(config)
        self.register_buffer("symbol_ids", torch.tensor(self.tokens.symbols), persistent=False)
        self.zoedepth = build_depth(config)
        # a checkpoint of an earlier release has its grids in its config only
        self.may_skip = ("grids",) if self.zoedepth is not None else ("grids", "zoedepth")
        self.ego3d = Ego3D(
            self.backbone.vision_hidden_size,
            self.backbone.patches_per_side,
            config.ego3d_patch_reso,
            config.ego3d_n_freqs,
            config.ego3d_zero_init,
            config.ego3d_no_depth_vector,
        ).requires_grad_(config.has_positions)
        self.grids = make_grids(config, dataset_meta)
        self.layout = make_layout(config, self.tokens, self._cameras, self.backbone.tokens_per_image)
        num_answer = len(self._pointing_rows) + config.chunk_size * len(self.grids.groups)
        num_fixed = self.layout.num_tokens + num_answer
        self._check_length(self.backbone.text_config, num_fixed, config.prompt_template, dataset_meta)
        self._num_cells_of_base: list[int] | None = None  # if the grids are other than the checkpoint's
        hidden_size = self.backbone.text_config.hidden_size
        self.cell_embedding = nn.Embedding(self._num_rows, hidden_size)
        self.cell_head = nn.Linear(hidden_size, self._num_rows, bias=False)
        self._init_cells()
        self._add_board_reader(hidden_size, self.backbone.tokens_per_image)
        self._bidirectional_prompt = config.prefix_attention == "bidirectional"
        self._decoder = SlotDecoder(
            self.backbone.text_model,
            self.backbone.positions,
            bidirectional_prompt=self._bidirectional_prompt,
            cap=self.backbone.cap,
            drafted=config.draft != "none",
            compiled=config.compile_model,
        )
        self.state_bins = Bins(NUM_STATE_BINS, "centers")
        self._ensemble = self._make_ensemble()
        self.reset()

    @classmethod
    def _prepare(cls, config: SpatialvlaGridConfig, meta: LeRobotDatasetMetadata | None) -> None:
        """Prepare as other policies do; grids are as they were, or adapt to the new data."""
        complete_depth(config, meta)
        config.check_template_as_trained()
        is_refitted = meta is not None and config.adapt_embeddings and not config.keep_statistics
        config.check_grid_as_trained(is_refitted=is_refitted)
        super()._prepare(config, meta)

    @classmethod
    def _load_as_safetensor(
        cls, model: "SpatialvlaGridPolicy", model_file: str, map_location: str, strict: bool
    ) -> "SpatialvlaGridPolicy":
        """Load as other policies do, with the ZoeDepth of ``depth_model_name`` where the file has none."""
        if model.zoedepth is not None and not holds_module(Path(model_file), "zoedepth"):
            model.zoedepth = load_zoedepth(model.config.depth_model_name)
            model.may_lack = (*model.may_lack, "zoedepth")
        return super()._load_as_safetensor(model, model_file, map_location, strict)

    def _start_on(self, meta: LeRobotDatasetMetadata, actions: Statistics) -> None:
        super()._start_on(meta, actions)
        if self.pointer is not None:
            self.config.take_places(meta)
            self.pointer.fit(actions, self.config.normalization_mapping["ACTION"])

    def _fit(self, meta: LeRobotDatasetMetadata) -> None:
        super()._fit(meta)
        if self.config.adapt_embeddings:
            self._adapt(meta)

    @torch.no_grad()
    def _init_cells(self) -> None:
        """Draw the cells' rows around the mean of the words' embeddings, as a tokenizer's new tokens are."""
        words = self.backbone.vlm.get_input_embeddings().weight
        assert isinstance(words, Tensor)
        for table in (self.cell_embedding.weight, self.cell_head.weight):
            nn.init.normal_(table, std=self.backbone.text_config.initializer_range)
            table += words.mean(dim=0)

    @torch.no_grad()
    def _adapt(self, meta: LeRobotDatasetMetadata) -> None:
        """Fit the grids to another dataset; interpolate each new cell's rows from the old grids."""
        old, new = self.grids, ActionGrids(self.config.grid_settings(), self.action_dim)
        fit_to_data(new, self.config, meta)
        if new.to_dict() == old.to_dict():  # a training that is resumed
            return
        if self.config.use_peft:
            raise ValueError(
                f"{self.config.pretrained_path} holds adapters and cells of other grids than this dataset's; "
                "train on what lerobot-bomb checkpoint merge makes of them, or give "
                "--policy.adapt_embeddings=false"
            )
        for table in (self.cell_embedding, self.cell_head):
            cells, others = table.weight.tensor_split([old.num_tokens])
            table.weight = nn.Parameter(torch.cat([interpolate_rows(old, new, cells), others]))
        names = dim_names(meta.features[ACTION])
        edges = edges_text(old, names), edges_text(new, names)
        logger.info("Action grids adapted.\nOld edges\n%s\nNew edges\n%s", *edges)
        self._num_cells_of_base = old.num_cells
        self.grids = new.to(self._device)
        self.cell_embedding.num_embeddings = self.cell_head.out_features = self._num_rows
        self.config.grid_params = new.to_dict()

    def scored(self) -> ScoredSpatialvlaGrid:
        """Return the policy as `lerobot_bomb.explain` scores its answers."""
        return ScoredSpatialvlaGrid(self)

    def _newest_only(self) -> list[int]:
        binary = [dim for group in self.grids.groups if group.transform == "binary" for dim in group.dims]
        return sorted({*binary, *super()._newest_only()})

    def _get_default_peft_targets(self) -> dict[str, Any]:
        """Return the original's targets: linear layers of text, vision, projector and Ego3D; cells whole."""
        return peft_targets(self, "language_model", (*CELL_TABLES, BOARD_READER), adapted_layers(self.config))

    def _validate_peft_config(self, peft_config: Any) -> None:
        """Check that adapters hold the cells of adapted grids, by the adapters' config."""
        super()._validate_peft_config(peft_config)
        if self._num_cells_of_base is not None:
            num_cells = self.grids.num_cells, self._num_cells_of_base
            check_adapted_cells(self.config, peft_config.modules_to_save or [], *num_cells)

    # Training

    def forward(self, batch: dict[str, Tensor], reduction: str = "mean") -> tuple[Tensor, dict[str, float]]:
        """Return the answer's cross-entropy over the loss mask; ``reduction="none"`` gives (B,)."""
        if reduction not in ("mean", "none"):
            raise ValueError(f"reduction={reduction!r} is unknown; choose mean or none")
        self._begin_batch()
        cells_BTG, loss_mask_BT, pointed = self._targets(batch)
        given_BS, answer_BS = self._join(pointed.given, cells_BTG), self._join(pointed.meant, cells_BTG)
        with self.autocast():
            hidden_BSH, features_BPH = self._hidden(batch, given_BS)
            losses_BS, chosen_BS = self._losses(hidden_BSH, answer_BS)
        chosen_BN, chosen_BTG = self._split(chosen_BS)
        num_pointing = chosen_BN.shape[1]
        loss_mask_BTG = loss_mask_BT[..., None].expand_as(chosen_BTG)
        loss_mask_BS = pad(loss_mask_BTG.flatten(1), (num_pointing, 0), value=True)
        losses_BS = losses_BS * loss_mask_BS
        losses_BS[:, :num_pointing] *= self.config.pointing_loss_weight
        parts = self._cell_parts(chosen_BTG, cells_BTG, loss_mask_BTG) | pointed.parts(chosen_BN)
        if reduction == "none":
            loss = losses_BS.sum(dim=1) / loss_mask_BS.sum(dim=1).clamp(min=1)
        else:
            loss = losses_BS.sum() / loss_mask_BS.sum().clamp(min=1)
            loss = weighed(loss, loss_mask_BS) if self.training else loss
        loss, board = self._with_board(loss, batch, features_BPH)
        return loss, means(parts | board, loss, self.config.trained_batches)

    def _targets(self, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor, Target]:
        """Return cells (B, T, G), the loss mask (B, T) of steps, and the pointing tokens ahead of them."""
        shape = self.config.chunk_size, self.action_dim
        actions_BTD = read_actions(batch, ACTION, self.config.type, self._device, shape)
        loss_mask_BT = self._loss_mask(batch)
        if self.pointer is None:
            return (
                self.grids.encode(actions_BTD),
                loss_mask_BT,
                Target.nothing(len(loss_mask_BT), self._device),
            )
        labels, pointed = self.pointer.labels(batch, self._other_share, self.config.type, self.generator)
        actions_BTD, loss_mask_BT = labels.given_actions(
            actions_BTD, loss_mask_BT, labels.other_actions[:, None]
        )
        return self.grids.encode(actions_BTD), loss_mask_BT, pointed

    def _hidden(self, batch: dict[str, Tensor], answer_BS: Tensor) -> tuple[Tensor, Tensor]:
        """Return teacher-forced states (B, S, H) that predict an answer, and image features of all cameras.

        The features are (B, P of all images, H).
        """
        prompt = self.prompt(batch)
        embeds_BLH = self.embed(prompt.ids, self.encode_images(batch))
        features_BPH = embeds_BLH[:, self.layout.image_columns(embeds_BLH.device)]
        return self._hidden_after(prompt, embeds_BLH, answer_BS), features_BPH

    def _hidden_after(self, prompt: TokenRows, embeds_BLH: Tensor, answer_BS: Tensor) -> Tensor:
        """Return the states of `_hidden`, for prompts that are embedded already."""
        rows_BS = answer_BS.clone()
        for rows, positions in self._slots():
            rows_BS[:, positions] += rows.start
        embeds_BXH = torch.cat([embeds_BLH, self._embed_cells(rows_BS[:, :-1])], dim=1)
        answer = TokenRows(rows_BS[:, 1:], torch.ones_like(rows_BS[:, 1:], dtype=torch.bool))
        tokens = TokenRows.join([prompt, answer])
        index_X = torch.arange(tokens.mask.shape[1], device=rows_BS.device)
        attention_mask_XX = index_X <= index_X[:, None]
        if self._bidirectional_prompt:
            is_prompt_X = index_X < prompt.mask.shape[1]
            attention_mask_XX |= is_prompt_X & is_prompt_X[:, None]
        hidden_BXH = self.backbone.hidden_states(
            embeds_BXH,
            (tokens.mask.cumsum(dim=1) - 1).clamp(min=0),
            attention_mask_XX & tokens.attention_mask[:, None],
        )
        return hidden_BXH[:, -rows_BS.shape[1] :]

    def _split(self, answer: Tensor) -> tuple[Tensor, Tensor]:
        """(B, S, ...) of an answer -> (B, N, ...) of pointing tokens and (B, T, G, ...) of cells."""
        pointing, cells = answer.tensor_split([len(self._pointing_rows)], dim=1)
        return pointing, cells.unflatten(1, (-1, len(self.grids.groups)))

    @staticmethod
    def _join(pointing_BN: Tensor, cells_BTG: Tensor) -> Tensor:
        """Return the answer (B, S) that `_split` takes apart."""
        return torch.cat([pointing_BN, cells_BTG.flatten(1)], dim=1)

    def _slots(self) -> list[tuple[slice, slice]]:
        """Return the rows of the tables and the positions in an answer, of each pointing token and group."""
        pointing, groups = self._pointing_rows, self._group_rows
        once = [(rows, slice(i, i + 1)) for i, rows in enumerate(pointing)]
        in_each_step = [(rows, slice(len(pointing) + i, None, len(groups))) for i, rows in enumerate(groups)]
        return once + in_each_step

    def log_probability(self, prompt: TokenRows, embeds_BLH: Tensor, answer_BS: Tensor) -> Tensor:
        """Return log-probabilities (B,) of answers after embedded prompts."""
        hidden_BSH = self._hidden_after(prompt, embeds_BLH, answer_BS)
        chosen = []
        for rows, positions in self._slots():
            logits_BTC = self._logits(rows, hidden_BSH[:, positions]).float()
            chosen.append(logits_BTC.log_softmax(dim=-1).gather(-1, answer_BS[:, positions, None]))
        return torch.cat(chosen, dim=1).sum(dim=(1, 2))

    def _losses(self, hidden_BSH: Tensor, answer_BS: Tensor) -> tuple[Tensor, Tensor]:
        """Return losses and likeliest tokens, (B, S) each."""
        losses_BS, chosen_BS = torch.empty_like(answer_BS, dtype=torch.float32), torch.empty_like(answer_BS)
        for rows, positions in self._slots():
            hidden_BTH, labels_BT = hidden_BSH[:, positions], answer_BS[:, positions]
            logits_BTC = self._logits(rows, hidden_BTH).float()
            chosen_BS[:, positions] = logits_BTC.detach().argmax(dim=-1)
            if self.config.loss_vocab == "full":
                logits_BTC, labels_BT = self._full_logits(hidden_BTH), labels_BT + rows.start
            losses_BS[:, positions] = cross_entropy(logits_BTC.transpose(1, 2), labels_BT, reduction="none")
        return losses_BS, chosen_BS

    def _full_logits(self, hidden: Tensor) -> Tensor:
        """(..., H) -> logits (..., all cells, then the vocabulary)."""
        logits = [self.cell_head(hidden), self.backbone.vlm.lm_head(hidden)]
        return self.backbone.cap(torch.cat(logits, dim=-1).float())

    @torch.no_grad()
    def _cell_parts(
        self, chosen_BTG: Tensor, cells_BTG: Tensor, loss_mask_BTG: Tensor
    ) -> dict[str, tuple[Tensor, Tensor]]:
        """Return which cells are right and absolute errors in the data's units, as `means` takes them.

        Teacher-forced: every cell is predicted from the true ones before it. Padded actions do not count.
        Errors are known only with a dataset, that is in training.
        """
        parts = {"token_accuracy": (chosen_BTG == cells_BTG, loss_mask_BTG)}
        errors_BTD = (self.grids.decode(chosen_BTG) - self.grids.decode(cells_BTG)).abs() * self.action_unit
        return parts | self._l1_parts(errors_BTD, loss_mask_BTG[..., :1].expand_as(errors_BTD))

    # Inference

    def _predict(self, batch: dict[str, Tensor], num_steps: int) -> Tensor:
        """Return the first ``num_steps`` actions of the chunk; the model need not choose the rest."""
        return self.grids.decode(self.choose(batch, num_steps))

    def choose(self, batch: dict[str, Tensor], num_steps: int) -> Tensor:
        """Choose cells (B, num_steps, G)."""
        return self._split(self.write(batch, num_steps))[1]

    @torch.no_grad()
    def write(self, batch: dict[str, Tensor], num_steps: int) -> Tensor:
        """Write answers (B, S): pointing tokens, then the cells of all steps."""
        self.eval()
        with self.autocast():
            prompt = self.prompt(batch)
            embeds_BLH = self.embed(prompt.ids, self.encode_images(batch))
            answer_BS = self._decoder(
                Prompt(embeds_BLH, prompt.mask, prompt.hidden),
                self._group_rows,
                num_steps,
                self.cell_embedding.weight * self.backbone.embed_scale,
                self.cell_head.weight,
                self._choice_noise(len(embeds_BLH), (num_steps, self._num_rows)),
                ahead=self._pointing_rows,
            )
        # casts of weights cached under inference mode cannot be used by a later training step
        torch.clear_autocast_cache()
        return answer_BS

    def pointed(self, batch: dict[str, Tensor]) -> PointedAt | None:
        """Return what the policy points at in a batch of one row; None if it does not point."""
        if self.pointer is None:
            return None
        answer_1S = self.write(batch, self.config.chunk_size)
        with torch.no_grad(), self.autocast():
            hidden_1SH, _ = self._hidden(batch, answer_1S)
            logits_1P = self._logits(self._pointing_rows[0], hidden_1SH[:, 0]).float()
        return self.pointer.pointed_at(self._split(answer_1S)[0][0], logits_1P[0].softmax(dim=0))

    @property
    def last_passes(self) -> int | None:
        """Passes of the text model in the last prediction, the prompt's included; None if there was none."""
        return self._decoder.num_passes

    @property
    def last_tokens(self) -> int:
        """Number of a prediction's cells that are executed."""
        num_steps = self.config.temporal_ensemble_size or self.config.n_action_steps
        return num_steps * len(self.grids.groups)

    # Cells

    def _embed_cells(self, rows: Tensor) -> Tensor:
        """Numbers of the table's rows -> (..., H), at the scale of the words' embeddings."""
        return self.cell_embedding(rows) * self.backbone.embed_scale

    def _logits(self, rows: slice, hidden: Tensor) -> Tensor:
        """(..., H) -> logits (..., those rows of the table)."""
        return self.backbone.cap(linear(hidden, self.cell_head.weight[rows]))

    @property
    def _group_rows(self) -> list[slice]:
        """Rows of the tables that are each group's cells."""
        counts = zip(self.grids.offsets, self.grids.num_cells, strict=True)
        return [slice(first, first + count) for first, count in counts]

    @property
    def _pointing_rows(self) -> list[slice]:
        """Rows, after those of the cells, that may be chosen for each of the N pointing tokens."""
        return [] if self.pointer is None else self.pointer.slots(self.grids.num_tokens)

    @property
    def _num_rows(self) -> int:
        """Number of rows of the tables."""
        return self.grids.num_tokens + (0 if self.pointer is None else self.pointer.num_tokens)

    # Prompt

    def _prompt_rows(self, batch: dict[str, Tensor]) -> dict[str, TokenRows]:
        if not self.config.use_state:
            return {}
        numbers_BN = self.state_bins.encode(self._state(batch))
        symbols_BNC, mask_BNC = number_symbols(numbers_BN, digits_needed(NUM_STATE_BINS), zero_padded=False)
        return {STATE: TokenRows(self.symbol_ids[symbols_BNC].flatten(1), mask_BNC.flatten(1))}

    def embed(self, ids_BL: Tensor, features_BPH: Tensor) -> Tensor:
        """Embed prompts, (B, L, H), image features in place."""
        return self.layout.with_images(self.backbone.embed_tokens(ids_BL), features_BPH)

    def encode_images(self, batch: dict[str, Tensor]) -> Tensor:
        """Return image features (B, P of all images, H)."""
        features = [self._encode_image(batch, key) for key in self._cameras]
        return self.backbone.project(torch.cat(features, dim=1))

    def _encode_image(self, batch: dict[str, Tensor], key: str) -> Tensor:
        """Return features of a camera's patches with their positions, (B, P, vision model's hidden size)."""
        image = read_image(batch, key, self.config.type, self._device)
        windows = draw_windows(image, self.config.crop_fraction, self.generator if self.training else None)
        pixels = resized_pixels(windows.cut(image), self.backbone.image_size)
        camera, size = key.removeprefix(f"{OBS_IMAGES}."), self.ego3d.lattice_size
        points = camera_points(self.config, self.zoedepth, batch, camera, windows, pixels, size)
        features_BPE = self.backbone.encode_pixels(pixels)
        return features_BPE + self.ego3d(points).to(features_BPE.dtype)
