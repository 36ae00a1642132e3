"""``spatialvla_grid``: actions as cells of adaptive grids.

Sources: SpatialVLA (arXiv 2501.15830); PaliGemma 2 (arXiv 2412.03555).

Shapes: `B` batch, `T` actions of a chunk, `D` action dims, `G` groups of them, `S` = T * G slots of an
answer, `L` tokens of a prompt, `X` of a prompt and an answer, `H` hidden size, `P` tokens of an image, `C`
cells of a group.
"""

import logging
from pathlib import Path
from typing import Any, ClassVar

import torch
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION, OBS_IMAGES
from torch import Tensor, nn
from torch.nn.functional import cross_entropy, linear

from lerobot_bomb.actions.accuracy import means
from lerobot_bomb.actions.bins import Bins
from lerobot_bomb.actions.grid_report import edges_text
from lerobot_bomb.actions.grid_rows import interpolate_rows
from lerobot_bomb.actions.grids import ActionGrids
from lerobot_bomb.actions.text import TokenRows, digits_needed, number_symbols
from lerobot_bomb.checkpoints.adapters import peft_targets
from lerobot_bomb.checkpoints.checks import holds_module
from lerobot_bomb.data.columns import dim_names
from lerobot_bomb.decoding.decoder import Prompt
from lerobot_bomb.decoding.slots import SlotWriter
from lerobot_bomb.policies.policy import TokenVlaPolicy
from lerobot_bomb.training.distributed import weighed
from lerobot_bomb.training.randomness import begin_batch
from lerobot_bomb.vlm.depth import (
    lattice_points,
    load_zoedepth,
    observed_depth,
    observed_intrinsics,
)
from lerobot_bomb.vlm.ego3d import Ego3D
from lerobot_bomb.vlm.images import CropWindows, draw_windows, resized_pixels
from lerobot_bomb.vlm.inputs import read_actions, read_image, read_task
from lerobot_bomb.vlm.intrinsics import crop_intrinsics, default_intrinsics, resize_intrinsics
from lerobot_policy_spatialvla_grid.building_spatialvla_grid import (
    build_depth,
    build_model,
    complete_depth,
    fit_to_data,
    make_grids,
)
from lerobot_policy_spatialvla_grid.card_spatialvla_grid import METHOD
from lerobot_policy_spatialvla_grid.configuration_spatialvla_grid import (
    AS_TRAINED,
    NUM_STATE_BINS,
    SHAPES,
    SpatialvlaGridConfig,
)
from lerobot_policy_spatialvla_grid.explained_spatialvla_grid import ExplainedSpatialvlaGrid

logger = logging.getLogger(__name__)

# not of the base model: trained whole beside its adapters
CELL_TABLES = ("cell_embedding", "cell_head")
# patterns of modules that have adapters beside the text model's
VISION_LAYERS = r"backbone\.vlm\.model\.vision_tower\..*\.((q|k|v|out)_proj|fc[12])"
PROJECTOR = r"backbone\.vlm\.model\.multi_modal_projector\.linear"
EGO3D_LAYERS = r"ego3d\.layers\.[03]"


class SpatialvlaGridPolicy(TokenVlaPolicy):
    """A PaliGemma 2 that chooses the next ``chunk_size`` actions, one cell of each grid a step."""

    config_class = SpatialvlaGridConfig  # pyright: ignore[reportAssignmentType]  LeRobot annotates it as None
    name = "spatialvla_grid"  # pyright: ignore[reportAssignmentType]
    method = METHOD
    config: SpatialvlaGridConfig
    shapes, as_trained = SHAPES, AS_TRAINED
    symbol_ids: Tensor
    first_cells: Tensor  # (G,) int64, of each group among all cells
    # modules that FSDP shards one by one; accelerate reads the second name
    _fsdp_wrap_modules: ClassVar[list[str]] = ["Gemma2DecoderLayer", "SiglipEncoderLayer"]
    _no_split_modules = _fsdp_wrap_modules

    def __init__(
        self, config: SpatialvlaGridConfig, dataset_meta: LeRobotDatasetMetadata | None = None, **_: object
    ):
        super().__init__(config, dataset_meta)
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
        self._check_length(
            self.backbone.text_config, self._num_fixed_tokens(), config.prompt_template, dataset_meta
        )
        self._num_cells_of_base: list[int] | None = None  # if the grids are other than the checkpoint's
        self.register_buffer("first_cells", torch.tensor(self.grids.offsets), persistent=False)
        hidden_size = self.backbone.text_config.hidden_size
        self.cell_embedding = nn.Embedding(self.grids.num_tokens, hidden_size)
        self.cell_head = nn.Linear(hidden_size, self.grids.num_tokens, bias=False)
        self._init_cells()
        self._writer = SlotWriter(
            self.backbone.text_model,
            self.backbone.positions,
            prompt_reads_all=self._prompt_reads_all,
            cap=self.backbone.cap,
            drafted=config.draft != "none",
            compiled=config.compile_model,
        )
        self.state_bins = Bins(NUM_STATE_BINS, "centers")
        self._ensemble = self._make_ensemble()
        self.reset()

    @classmethod
    def _prepare(cls, config: SpatialvlaGridConfig, meta: LeRobotDatasetMetadata | None) -> None:
        """As the others'; grids are as they were, or adapt to the new data."""
        complete_depth(config, meta)
        config.check_template_as_trained()
        config.check_grid_as_trained(is_refitted=meta is not None and config.adapt_embeddings)
        super()._prepare(config, meta)

    @classmethod
    def _load_as_safetensor(
        cls, model: "SpatialvlaGridPolicy", model_file: str, map_location: str, strict: bool
    ) -> "SpatialvlaGridPolicy":
        """As the others', and with the ZoeDepth of ``depth_model_name`` where the checkpoint has none."""
        if model.zoedepth is not None and not holds_module(Path(model_file), "zoedepth"):
            model.zoedepth = load_zoedepth(model.config.depth_model_name)
            model.may_lack = ("zoedepth",)
        return super()._load_as_safetensor(model, model_file, map_location, strict)

    def _fit(self, meta: LeRobotDatasetMetadata) -> None:
        if self.config.adapt_embeddings:
            self._adapt(meta)
        super()._fit(meta)

    @torch.no_grad()
    def _init_cells(self) -> None:
        """Around the mean of the words' embeddings, as a tokenizer's new tokens are."""
        words = self.backbone.vlm.get_input_embeddings().weight
        assert isinstance(words, Tensor)
        for table in (self.cell_embedding.weight, self.cell_head.weight):
            nn.init.normal_(table, std=self.backbone.text_config.initializer_range)
            table += words.mean(dim=0)

    @torch.no_grad()
    def _adapt(self, meta: LeRobotDatasetMetadata) -> None:
        """Fit the grids to another dataset; a cell's rows become those of where it lies in the old grids."""
        old, new = self.grids, ActionGrids(self.config.grid_settings(), self._action_dim)
        fit_to_data(new, self.config, meta)
        if new.to_dict() == old.to_dict():  # a training that is resumed
            return
        if self.config.use_peft:
            raise ValueError(
                f"{self.config.pretrained_path} holds adapters and cells of other grids than this dataset's; "
                "train on what lerobot-bomb merge makes of them, or give --policy.adapt_embeddings=false"
            )
        for table in (self.cell_embedding, self.cell_head):
            table.weight = nn.Parameter(interpolate_rows(old, new, table.weight))
        self.cell_embedding.num_embeddings = self.cell_head.out_features = new.num_tokens
        names = dim_names(meta.features[ACTION])
        edges = edges_text(old, names), edges_text(new, names)
        logger.info("Action grids adapted.\nOld edges\n%s\nNew edges\n%s", *edges)
        self._num_cells_of_base = old.num_cells
        self.grids = new.to(self._device)
        self.first_cells = torch.tensor(new.offsets, device=self._device)
        self.config.grid_params = new.to_dict()

    def explained(self) -> ExplainedSpatialvlaGrid:
        """This policy as `lerobot_bomb.explain` asks it."""
        return ExplainedSpatialvlaGrid(self)

    def _newest_only(self) -> list[int]:
        binary = [dim for group in self.grids.groups if group.transform == "binary" for dim in group.dims]
        return sorted({*binary, *super()._newest_only()})

    def _get_default_peft_targets(self) -> dict[str, Any]:
        """The original's: linear layers of text and vision model, projector, Ego3D; and the cells whole."""
        others = [PROJECTOR]
        if not self.config.freeze_vision_encoder:
            others.append(VISION_LAYERS)
        if self.config.depth_source != "none":
            others.append(EGO3D_LAYERS)
        return peft_targets(self, "language_model", CELL_TABLES, others)

    def _validate_peft_config(self, peft_config: Any) -> None:
        """Grids that were adapted are in the adapters' config, so the adapters must hold their cells."""
        super()._validate_peft_config(peft_config)
        if self._num_cells_of_base is None:
            return
        trained_whole = peft_config.modules_to_save or []
        if not {*CELL_TABLES} <= {*trained_whole}:
            raise ValueError(
                f"--peft.full_training_modules={trained_whole} leaves out the cells, which were adapted to "
                f"this dataset; have {' and '.join(CELL_TABLES)} in it, or give "
                "--policy.adapt_embeddings=false"
            )
        if self._num_cells_of_base != self.grids.num_cells:
            raise ValueError(
                f"--policy.action_groups: adapters cannot be trained on grids of {self.grids.num_cells} "
                f"cells, as those of {self.config.pretrained_path} have {self._num_cells_of_base}; leave it "
                "as it is"
            )

    # Training

    def forward(self, batch: dict[str, Tensor], reduction: str = "mean") -> tuple[Tensor, dict[str, float]]:
        """Cross-entropy of the cells, over the kept ones; ``reduction="none"`` gives (B,)."""
        if reduction not in ("mean", "none"):
            raise ValueError(f"reduction={reduction!r} is unknown; choose mean or none")
        if self.training:
            begin_batch(self.config, self.generator)
        shape = self.config.chunk_size, self._action_dim
        actions_BTD = read_actions(batch, ACTION, self.config.type, self._device, shape)
        cells_BTG = self.grids.encode(actions_BTD)
        with self._autocast():
            hidden_BTGH = self._hidden(batch, cells_BTG)
            losses_BTG, chosen_BTG = self._losses(hidden_BTGH, cells_BTG)
        kept_BTG = self._kept(batch)[..., None].expand_as(losses_BTG)
        losses_BTG = losses_BTG * kept_BTG
        metrics = self._metrics(chosen_BTG, cells_BTG, kept_BTG, losses_BTG)
        if reduction == "none":
            losses_B, counts_B = losses_BTG.sum(dim=(1, 2)), kept_BTG.sum(dim=(1, 2))
            return losses_B / counts_B.clamp(min=1), metrics
        loss = losses_BTG.sum() / kept_BTG.sum().clamp(min=1)
        return weighed(loss, kept_BTG) if self.training else loss, metrics

    def _hidden(self, batch: dict[str, Tensor], cells_BTG: Tensor) -> Tensor:
        """(B, T, G, H) teacher-forced states that predict the cells."""
        prompt = self._prompt(batch)
        return self._hidden_after(prompt, self._embeds(batch, prompt.ids), cells_BTG)

    def _hidden_after(self, prompt: TokenRows, embeds_BLH: Tensor, cells_BTG: Tensor) -> Tensor:
        """The same, after a prompt that was embedded before."""
        cells_BS = (cells_BTG + self.first_cells).flatten(1)
        embeds_BXH = torch.cat([embeds_BLH, self._embed_cells(cells_BS[:, :-1])], dim=1)
        answer = TokenRows(cells_BS[:, 1:], torch.ones_like(cells_BS[:, 1:], dtype=torch.bool))
        rows = TokenRows.join([prompt, answer])
        index_X = torch.arange(rows.mask.shape[1], device=cells_BS.device)
        reads_XX = index_X <= index_X[:, None]
        if self._prompt_reads_all:
            is_prompt_X = index_X < prompt.mask.shape[1]
            reads_XX |= is_prompt_X & is_prompt_X[:, None]
        hidden_BXH = self.backbone.hidden_states(
            embeds_BXH,
            (rows.mask.cumsum(dim=1) - 1).clamp(min=0),
            reads_XX & rows.readable[:, None],
        )
        return hidden_BXH[:, -cells_BS.shape[1] :].unflatten(1, cells_BTG.shape[1:])

    def _losses(self, hidden_BTGH: Tensor, cells_BTG: Tensor) -> tuple[Tensor, Tensor]:
        """(B, T, G) losses and the likeliest cells, group by group."""
        losses, chosen = [], []
        for group, hidden_BTH in enumerate(hidden_BTGH.unbind(dim=2)):
            logits_BTC = self._cell_logits(group, hidden_BTH).float()
            chosen.append(logits_BTC.detach().argmax(dim=-1))
            labels_BT = cells_BTG[..., group]
            if self.config.loss_vocab == "full":
                logits_BTC, labels_BT = self._full_logits(hidden_BTH), labels_BT + self.first_cells[group]
            losses.append(cross_entropy(logits_BTC.transpose(1, 2), labels_BT, reduction="none"))
        return torch.stack(losses, dim=2), torch.stack(chosen, dim=2)

    def _full_logits(self, hidden_BTH: Tensor) -> Tensor:
        """(B, T, all cells, then the vocabulary)."""
        logits = [self.cell_head(hidden_BTH), self.backbone.vlm.lm_head(hidden_BTH)]
        return self.backbone.cap(torch.cat(logits, dim=-1).float())

    @torch.no_grad()
    def _metrics(
        self, chosen_BTG: Tensor, cells_BTG: Tensor, kept_BTG: Tensor, losses_BTG: Tensor
    ) -> dict[str, float]:
        """Share of right cells, mean absolute errors of what cells decode to in the data's units.

        Teacher-forced: every cell is predicted from the true ones before it. Padded actions do not count.
        Errors are known where a dataset was given, that is while training.
        """
        parts = {"token_accuracy": (chosen_BTG == cells_BTG, kept_BTG)}
        errors_BTD = (self.grids.decode(chosen_BTG) - self.grids.decode(cells_BTG)).abs() * self.action_unit
        parts |= self._l1_parts(errors_BTD, kept_BTG[..., :1].expand_as(errors_BTD))
        return means(parts, losses_BTG, self.config.trained_batches)

    # Inference

    def _predict(self, batch: dict[str, Tensor], num_steps: int) -> Tensor:
        """The first ``num_steps`` actions of the chunk; the model need not choose the rest."""
        return self.grids.decode(self._choose(batch, num_steps))

    @torch.no_grad()
    def _choose(self, batch: dict[str, Tensor], num_steps: int) -> Tensor:
        """(B, num_steps, G) cells."""
        self.eval()
        num_groups = len(self.grids.groups)
        with self._autocast():
            prompt = self._prompt(batch)
            embeds_BLH = self._embeds(batch, prompt.ids)
            cells_BS = self._writer(
                Prompt(embeds_BLH, prompt.mask, prompt.hidden),
                self._group_rows,
                num_steps,
                self.cell_embedding.weight * self.backbone.embed_scale,
                self.cell_head.weight,
                self._choice_noise(len(embeds_BLH), (num_steps, self.grids.num_tokens)),
            )
        # casts of weights cached under inference mode cannot be used by a later training step
        torch.clear_autocast_cache()
        return cells_BS.unflatten(1, (num_steps, num_groups))

    @property
    def last_passes(self) -> int | None:
        """Of the text model in the last prediction, the prompt's included; None: there was none."""
        return self._writer.num_passes

    @property
    def last_tokens(self) -> int:
        """Cells of a prediction that is executed."""
        num_steps = self.config.temporal_ensemble_size or self.config.n_action_steps
        return num_steps * len(self.grids.groups)

    # Cells

    def _embed_cells(self, tokens: Tensor) -> Tensor:
        """Cells of all groups, numbered on -> (..., H), at the scale of the words' embeddings."""
        return self.cell_embedding(tokens) * self.backbone.embed_scale

    def _cell_logits(self, group: int, hidden: Tensor) -> Tensor:
        """(..., H) -> (..., cells of the group)."""
        return self.backbone.cap(linear(hidden, self.cell_head.weight[self._group_rows[group]]))

    @property
    def _group_rows(self) -> list[slice]:
        """Which rows of the tables are each group's cells."""
        counts = zip(self.grids.offsets, self.grids.num_cells, strict=True)
        return [slice(first, first + count) for first, count in counts]

    # Prompt

    def _prompt(self, batch: dict[str, Tensor]) -> TokenRows:
        """Everything before the answer, with padding; its last column has none."""
        return TokenRows.join([*self._prompt_parts(batch).values()])

    def _prompt_parts(self, batch: dict[str, Tensor]) -> dict[str, TokenRows]:
        """The same by what it is of; an image's by its camera."""
        tokens = self.tokens
        task = read_task(batch, self.config.type, self._device)
        image = self.backbone.tokens_per_image * [tokens.image]
        parts = {camera: TokenRows.constant(image, task.ids) for camera in self._cameras}
        parts |= {"start": TokenRows.constant(tokens.start, task.ids), "instruction": task}
        if self.config.use_state:
            numbers_BN = self.state_bins.encode(self._state(batch))
            symbols_BNC, mask_BNC = number_symbols(
                numbers_BN, digits_needed(NUM_STATE_BINS), zero_padded=False
            )
            state = TokenRows(self.symbol_ids[symbols_BNC].flatten(1), mask_BNC.flatten(1))
            parts["state"] = TokenRows.join([TokenRows.constant(tokens.state_start, task.ids), state])
        return parts | {"end": TokenRows.constant(tokens.task_end, task.ids)}

    def _num_fixed_tokens(self) -> int:
        """Of the longest prompt and answer, without the task."""
        tokens, config = self.tokens, self.config
        num_tokens = len(self._cameras) * self.backbone.tokens_per_image
        num_tokens += len(tokens.start) + len(tokens.task_end) + config.chunk_size * len(self.grids.groups)
        if config.use_state:
            assert config.robot_state_feature is not None
            width = 1 + digits_needed(NUM_STATE_BINS)
            num_tokens += len(tokens.state_start) + width * config.robot_state_feature.shape[0]
        return num_tokens

    def _embeds(self, batch: dict[str, Tensor], ids_BL: Tensor) -> Tensor:
        """Embeddings (B, L, H) of a prompt, image features in place."""
        features = [self._see(batch, key) for key in self._cameras]
        features_BPH = self.backbone.project(torch.cat(features, dim=1))
        words_BLH = self.backbone.embed_tokens(ids_BL[:, features_BPH.shape[1] :])
        return torch.cat([features_BPH.to(words_BLH.dtype), words_BLH], dim=1)

    def _see(self, batch: dict[str, Tensor], key: str) -> Tensor:
        """Features of a camera's patches, which know where they are: (B, P, vision model's hidden size)."""
        image = read_image(batch, key, self.config.type, self._device)
        windows = draw_windows(image, self.config.crop_fraction, self.generator if self.training else None)
        pixels = resized_pixels(windows.cut(image), self.backbone.image_size)
        points = self._points(batch, key.removeprefix(f"{OBS_IMAGES}."), windows, pixels)
        features_BPE = self.backbone.see(pixels)
        return features_BPE + self.ego3d(points).to(features_BPE.dtype)

    def _points(self, batch: dict[str, Tensor], camera: str, windows: CropWindows, pixels: Tensor) -> Tensor:
        """(B, R, R, 3) metres in the camera's frame of what the lattice's pixels show; NaN: not known."""
        config, size = self.config, self.ego3d.lattice_size
        if config.depth_source == "none":
            return pixels.new_full((len(pixels), size, size, 3), torch.nan)
        if self.zoedepth is None:
            depth, default = windows.cut(observed_depth(batch, camera, windows.image_size)), None
        else:
            depth, default = self.zoedepth(pixels), default_intrinsics(*windows.image_size)
        intrinsics = observed_intrinsics(batch, camera, config.camera_intrinsics, default)
        intrinsics = crop_intrinsics(intrinsics.to(pixels.device), windows)
        depth_size = depth.shape[-2], depth.shape[-1]
        intrinsics = resize_intrinsics(intrinsics, (windows.height, windows.width), depth_size)
        return lattice_points(depth, intrinsics, size)

    @property
    def _prompt_reads_all(self) -> bool:
        return self.config.prefix_attention == "bidirectional"
