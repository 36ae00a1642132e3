"""``fdvla``: noise to actions in a few steps, by a flow head and a denoising head together.

Source: FDVLA; where its equations contradict each other, the sound reading is in `lerobot_bomb.flow`.

Shapes: `B` batch, `K` actions of a chunk, `D` action dims, `L` tokens of a prompt, `T` = K + 3 of a segment
(begin, time, actions, end), `H` hidden size, `P` tokens of an image, `N` sampling steps.
"""

import logging
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar

import torch
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies.rtc import RTCProcessor
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor, nn

from lerobot_bomb.actions.accuracy import means
from lerobot_bomb.actions.relative import Statistics
from lerobot_bomb.actions.text import TokenRows
from lerobot_bomb.bomb.pointing import PointedAt
from lerobot_bomb.checkpoints.adapters import peft_targets
from lerobot_bomb.cuda_graphs import GraphedModel
from lerobot_bomb.finite import require_finite_answers
from lerobot_bomb.flow.dual_mod import masked_mean_pool
from lerobot_bomb.flow.losses import joint_loss, second_derivatives
from lerobot_bomb.flow.noise import SamplingNoise
from lerobot_bomb.flow.path import PathPoint, draw_tau, path_point
from lerobot_bomb.flow.real_time import guided, without_padding
from lerobot_bomb.flow.samplers import SAMPLERS, Heads, Predicted, num_evaluations, sample
from lerobot_bomb.policies.pointing import Labels
from lerobot_bomb.policies.pointing_policy import BOARD_READER, Parts, PointingVlaPolicy, plus
from lerobot_bomb.policies.policy import RelativeVlaPolicy
from lerobot_bomb.training.distributed import weighed
from lerobot_bomb.vlm.images import crop, encode_images
from lerobot_bomb.vlm.inputs import read_actions, read_image
from lerobot_bomb.vlm.layout import INSTRUCTION, STATE
from lerobot_policy_bomb.fdvla.building_fdvla import build_model, make_layout
from lerobot_policy_bomb.fdvla.card_fdvla import METHOD
from lerobot_policy_bomb.fdvla.configuration_fdvla import AS_TRAINED, SHAPES, FdvlaConfig
from lerobot_policy_bomb.fdvla.context_fdvla import Context
from lerobot_policy_bomb.fdvla.networks_fdvla import NUM_MARKS, ActionSegment, Head, SideBySide
from lerobot_policy_bomb.fdvla.pointing_fdvla import Pointed, make_pointer
from lerobot_policy_bomb.fdvla.scored_fdvla import ScoredFdvla

logger = logging.getLogger(__name__)

# not of the base model: trained whole beside its adapters
NEW_PARTS = ("segment", "state_embedding", "pointer", BOARD_READER, "flow_head", "denoise_head")


class FdvlaPolicy(RelativeVlaPolicy, PointingVlaPolicy):
    """A Qwen2.5-VL that reads noisy actions; two heads predict their velocity and their noise."""

    config_class = FdvlaConfig  # pyright: ignore[reportAssignmentType]  LeRobot annotates it as None
    name = "fdvla"  # pyright: ignore[reportAssignmentType]
    method = METHOD
    config: FdvlaConfig
    _sampling_noise: SamplingNoise
    shapes, as_trained = SHAPES, AS_TRAINED
    # modules that FSDP shards one by one; accelerate reads the second name
    _fsdp_wrap_modules: ClassVar[list[str]] = ["Qwen2_5_VLDecoderLayer", "Qwen2_5_VLVisionBlock"]
    _no_split_modules = _fsdp_wrap_modules

    def __init__(self, config: FdvlaConfig, dataset_meta: LeRobotDatasetMetadata | None = None, **_: object):
        super().__init__(config, dataset_meta)
        self.tokens, self.backbone = build_model(config)
        self.layout = make_layout(config, self.tokens, self._cameras, self.backbone.tokens_per_image)
        num_fixed = self.layout.num_tokens + config.chunk_size + NUM_MARKS
        self._check_length(self.backbone.text_config, num_fixed, "{}", dataset_meta)
        hidden_size = self.backbone.text_config.hidden_size
        self.segment = ActionSegment(config.chunk_size, self.action_dim, hidden_size)
        self.state_embedding = self._make_state_embedding(hidden_size)
        make_head = partial(Head, hidden_size, config.head_dim, self.action_dim)
        modulated = config.dualmod_flow, config.dualmod_denoise
        flow_dim, denoise_dim = (config.dualmod_dim if of_head else None for of_head in modulated)
        self.flow_head = make_head(flow_dim) if config.use_flow_head else None
        self.denoise_head = make_head(denoise_dim) if config.use_denoise_head else None
        self.pointer = make_pointer(config, hidden_size, dataset_meta)
        self._add_board_reader(hidden_size, self.backbone.tokens_per_image)
        logger.info("fdvla: %s", self.parameter_counts)
        heads = [head for head in (self.flow_head, self.denoise_head) if head is not None]
        self._captured = GraphedModel(self._sample, [self.backbone.text_model, self.segment, *heads])
        self.init_rtc_processor()
        self._sampling_noise = SamplingNoise(config.noise_seed, config.noise_per_episode)
        self._ensemble = self._make_ensemble()
        self.reset()

    def _make_state_embedding(self, hidden_size: int) -> nn.Linear | None:
        if not self.config.use_state:
            return None
        assert self.config.robot_state_feature is not None
        return nn.Linear(self.config.robot_state_feature.shape[0], hidden_size)

    def _start_on(self, meta: LeRobotDatasetMetadata, actions: Statistics) -> None:
        super()._start_on(meta, actions)
        if self.pointer is not None:
            self.config.take_places(meta)

    def _fit(self, meta: LeRobotDatasetMetadata) -> None:
        super()._fit(meta)
        if self.pointer is not None:
            self.pointer.fit_units(meta, self.config.normalization_mapping)

    @property
    def parameter_counts(self) -> dict[str, int]:
        """Number of parameters of each part, and of all that are trained."""
        counts = {name: sum(p.numel() for p in part.parameters()) for name, part in self.named_children()}
        return {**counts, "trained": sum(p.numel() for p in self.parameters() if p.requires_grad)}

    def scored(self) -> ScoredFdvla:
        """Return the policy as `lerobot_bomb.explain` scores its answers."""
        return ScoredFdvla(self)

    def _get_default_peft_targets(self) -> dict[str, Any]:
        return peft_targets(self, "language_model", NEW_PARTS)

    # Training

    def forward(self, batch: dict[str, Tensor], reduction: str = "mean") -> tuple[Tensor, dict[str, float]]:
        """Return the losses of both heads at random times of each chunk; ``reduction="none"`` gives (B,).

        A chunk gets ``draws_per_chunk`` times, as in CogACT (arXiv 2411.19650); `B` then counts them all.
        """
        self._begin_batch()
        draws = self.config.draws_per_chunk
        actions_BKD, loss_mask_BK, labels = self._targets(batch)
        actions_BKD, loss_mask_BK = (
            each.repeat_interleave(draws, dim=0) for each in (actions_BKD, loss_mask_BK)
        )
        point = self._draw_point(actions_BKD)
        with self.autocast(), second_derivatives(self.config.has_energy):
            if self.config.has_energy:
                point.actions.requires_grad_()
            context, pointing, read, features_BPH = self._read_and_point(batch, labels)
            heads = self._heads(context, loss_mask_BK)
            predicted = velocity_BKD, noise_BKD = heads(point.actions, point.tau)
            loss, terms = self._joint_loss(
                predicted,
                point,
                loss_mask_BK,
                reduction=reduction,
                consistency_loss_weight=self.config.used_consistency_weight,
                consistency=self.config.consistency,
                consistency_detach=self.config.consistency_detach,
            )
        if reduction == "none":
            loss = loss.unflatten(0, (-1, draws)).mean(dim=1)
        elif self.training:
            loss = weighed(loss, loss_mask_BK)
        for name, loss_B in pointing.items():
            loss = plus(loss, self.config.pointing_loss_weight, loss_B)
            terms[name] = loss_B.detach().mean()
        loss, board = self._with_board(loss, batch, features_BPH)
        return loss, self._metrics(
            loss, terms, read | board, velocity_BKD, noise_BKD, point, actions_BKD, loss_mask_BK
        )

    def _joint_loss(
        self, predicted: Predicted, point: PathPoint, loss_mask_BK: Tensor, **options: Any
    ) -> tuple[Tensor, dict[str, Tensor]]:
        velocity_BKD, noise_BKD = (None if values is None else values.float() for values in predicted)
        weights = {name: getattr(self.config, name) for name in ("flow_loss_weight", "denoise_loss_weight")}
        return joint_loss(velocity_BKD, noise_BKD, point, loss_mask_BK, **weights, **options)

    def chunk_loss(
        self, prompt: TokenRows, embeds_BLH: Tensor, state_BS: Tensor | None, point: PathPoint
    ) -> Tensor:
        """Return (B,) losses of both heads for embedded prompts, without their disagreement and pointing.

        ``B`` may be a multiple of the number of prompts. ``state_BS``: None without pointing.
        """
        context = self._context(prompt, embeds_BLH)
        if state_BS is not None:
            context = self._pointing(context, state_BS)
        all_BK = torch.ones(point.actions.shape[:2], dtype=torch.bool, device=point.actions.device)
        predicted = self._heads(context, all_BK)(point.actions, point.tau)
        return self._joint_loss(predicted, point, all_BK, reduction="none", consistency="none")[0]

    def _targets(self, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor, Labels | None]:
        """Return actions (B, K, D), the loss mask (B, K) over them, and labels of pointing."""
        actions_BKD, loss_mask_BK = self._actions(batch), self._loss_mask(batch)
        if self.pointer is None:
            return actions_BKD, loss_mask_BK, None
        labels = self.pointer.labels(batch, self._other_share, self.config.type, self.generator)
        other_B1D = self.to_relative(labels.other_actions[:, None], batch)
        return *labels.given_actions(actions_BKD, loss_mask_BK, other_B1D), labels

    def _read_and_point(
        self, batch: dict[str, Tensor], labels: Labels | None
    ) -> tuple[Context, dict[str, Tensor], Parts, Tensor]:
        """Return the context with the places that the heads are given, losses (B,) of pointing, what is read.

        Also return image features (B, P, H), P of all cameras, as the language model reads them.
        """
        context, embeds_BLH = self._read_embeds(batch)
        features_BPH = embeds_BLH[:, self.layout.image_columns(embeds_BLH.device)]
        if self.pointer is None or labels is None:
            return context, {}, {}, features_BPH
        pointed = self._point(context, self._of_batch(batch, OBS_STATE))
        context = replace(context, feedback=self.pointer.feed_back(pointed, labels.given))
        losses, right = self.pointer.losses(pointed, labels), self.pointer.parts(pointed, labels)
        return context, losses, right, features_BPH

    def _actions(self, batch: dict[str, Tensor]) -> Tensor:
        """Read actions (B, K, D) as the heads predict them: normalised, and relative if configured."""
        shape = self.config.chunk_size, self.action_dim
        actions_BKD = read_actions(batch, ACTION, self.config.type, self._device, shape).float()
        return self.to_relative(actions_BKD, batch)

    def _draw_point(self, actions_BKD: Tensor) -> PathPoint:
        tau_B = draw_tau(self.config.time_sampling, len(actions_BKD), self.generator)
        noise_BKD = torch.randn(actions_BKD.shape, generator=self.generator)
        return path_point(actions_BKD, noise_BKD.to(actions_BKD.device), tau_B.to(actions_BKD.device))

    @torch.no_grad()
    def _metrics(
        self,
        loss: Tensor,
        terms: dict[str, Tensor],
        read: Parts,
        velocity_BKD: Tensor | None,
        noise_BKD: Tensor | None,
        point: PathPoint,
        actions_BKD: Tensor,
        loss_mask_BK: Tensor,
    ) -> dict[str, float]:
        """Return loss terms, what is read right, and errors of the actions that A^tau and a head imply.

        Errors are in the data's units, and known only with a dataset. Padded actions do not count.
        """
        parts = {name: (term, torch.ones_like(term, dtype=torch.bool)) for name, term in terms.items()}
        limits = self.config.denoise_tau_min, self.config.clip_sample_range
        errors_BKD = point.implied_actions(velocity_BKD, noise_BKD, *limits) - actions_BKD
        errors_BKD = errors_BKD.abs() * self._unit
        parts |= read | self._l1_parts(errors_BKD, loss_mask_BK[..., None].expand_as(errors_BKD))
        return means(parts, loss, self.config.trained_batches)

    # Inference

    def _predict(self, batch: dict[str, Tensor], num_steps: int, noise: Tensor | None = None) -> Tensor:
        """Return the first ``num_steps`` normalised actions of the chunk, which is sampled as a whole."""
        return self.predict_action_chunk(batch, noise)[:, :num_steps]

    def predict_action_chunk(
        self,
        batch: dict[str, Tensor],
        noise: Tensor | None = None,
        *,
        inference_delay: int | None = None,
        prev_chunk_left_over: Tensor | None = None,
        execution_horizon: int | None = None,
    ) -> Tensor:
        """Return normalised actions (B, K, D), from ``noise`` (B, K, D) or else the episode's next noise.

        The other arguments are of LeRobot's real-time chunking, if ``rtc_config`` enables it: the last
        chunk's actions that are not executed yet, and how many will be when this chunk arrives.
        """
        self.eval()
        # real-time chunking takes gradients, and what is captured is written over
        with torch.inference_mode(False), torch.no_grad(), self.autocast():
            context = self._read(batch)
            if self.pointer is not None:
                context = self._pointing(context, self._of_batch(batch, OBS_STATE))
            shape = len(context.pooled), self.config.chunk_size, self.action_dim
            noises = self._noise(noise, shape), self._step_noise(shape)
            if self.rtc_processor is not None and prev_chunk_left_over is not None:
                delay, heads = inference_delay or 0, self._heads(context)
                left_over_BKD = self._left_over(prev_chunk_left_over, batch)
                heads = guided(heads, self.rtc_processor, left_over_BKD, delay, execution_horizon)
                actions_BKD = self._denoise(heads, *noises)
            elif self.action_unit.is_cuda:
                captured = self._captured(self.config.sampling(), *noises, *context.tensors())
                actions_BKD = captured[0].clone()
            else:
                actions_BKD = self._sample(*noises, *context.tensors())[0]
            actions_BKD = self.to_absolute(actions_BKD, batch)
        # casts of weights cached under inference mode cannot be used by a later training step
        torch.clear_autocast_cache()
        require_finite_answers(actions_BKD.isfinite().flatten(1).all(dim=1))
        return actions_BKD

    def pointed(self, batch: dict[str, Tensor]) -> PointedAt | None:
        """Return what the policy points at in a batch of one row; None if it does not point."""
        if self.pointer is None:
            return None
        self.eval()
        with torch.no_grad(), self.autocast():
            pointed = self._point(self._read(batch), self._of_batch(batch, OBS_STATE))
            return self.pointer.pointed_at(pointed)

    @property
    def last_passes(self) -> int:
        """Passes of the text model in a prediction: the prompt's, and those of the sampler's steps."""
        return 1 + num_evaluations(self.config.solver, self.config.num_inference_steps)

    def _left_over(self, actions_KD: Tensor, batch: dict[str, Tensor]) -> Tensor:
        """Return the last chunk's normalised actions, (K, D) or (B, K, D), as the heads predict them."""
        return self.to_relative(without_padding(actions_KD).to(self._device), batch)

    def _sample(self, noise_BKD: Tensor, step_noise: Tensor, *context: Tensor) -> tuple[Tensor]:
        """Run all sampling steps, as a function of tensors."""
        heads = self._heads(Context.of(context, has_feedback=self.pointer is not None))
        return (self._denoise(heads, noise_BKD, step_noise),)

    def _denoise(self, heads: Heads, noise_BKD: Tensor, step_noise: Tensor) -> Tensor:
        step_noise_BNKD = step_noise if self.config.used_sampler == "sde" else None
        return sample(heads, noise_BKD, **self.config.sampling(), step_noise_BNKD=step_noise_BNKD)

    def _noise(self, given: Tensor | None, shape: tuple[int, int, int]) -> Tensor:
        if given is None:
            return self._draw(shape[0], shape[1:])
        if given.shape != shape:
            raise ValueError(f"noise has shape {tuple(given.shape)}; expected {shape} (batch, chunk, dims)")
        return given.to(self._device)

    def _step_noise(self, shape: tuple[int, int, int]) -> Tensor:
        """Draw (B, N, K, D) for ``sde``, with N = 0 for others."""
        num_steps = self.config.num_inference_steps if self.config.used_sampler == "sde" else 0
        return self._draw(shape[0], (num_steps, *shape[1:]))

    def _draw(self, batch_size: int, shape: tuple[int, ...]) -> Tensor:
        return self._sampling_noise.draw(batch_size, shape).to(self._device)

    def supports_rtc(self) -> bool:
        """Return True if the sampler follows a velocity, which real-time chunking guides."""
        return "flow" in SAMPLERS[self.config.used_sampler]

    def init_rtc_processor(self) -> None:
        """Take ``config.rtc_config``, which LeRobot sets after the policy was made."""
        self.rtc_processor = None
        rtc_config = self.config.rtc_config
        if rtc_config is None or not rtc_config.enabled:
            return
        if not self.supports_rtc():
            raise ValueError(
                f"--policy.rtc_config: real-time chunking guides a velocity, and sampler="
                f"{self.config.used_sampler} has none; give --policy.sampler=flow or residual"
            )
        self.rtc_processor = RTCProcessor(rtc_config)

    # Model

    def _heads(self, context: Context, attended_BK: Tensor | None = None) -> Heads:
        """Return the function: noisy actions and times -> velocity and noise (B, K, D), None for no head.

        ``B`` may be a multiple of the number of observations; draws of one are consecutive. A call is one
        pass over the segment. Its shapes are static, and nothing in it waits for the device.
        """
        if attended_BK is None:
            shape = len(context.pooled), self.config.chunk_size
            attended_BK = torch.ones(shape, dtype=torch.bool, device=context.pooled.device)
        attention_mask_BTT = self._attention_mask(attended_BK)
        heads = self.flow_head, self.denoise_head
        of_draws = context.of_draws(len(attended_BK) // len(context.pooled))
        modulations = [None if head is None else head.modulation(of_draws.pooled) for head in heads]

        def predict(actions_BKD: Tensor, tau_B: Tensor) -> Predicted:
            states_BKH = self._action_states(context, actions_BKD, tau_B, attention_mask_BTT)
            if of_draws.feedback is not None:
                states_BKH = states_BKH + of_draws.feedback[:, None]
            velocity_BKD, noise_BKD = (
                None if head is None else head(states_BKH, modulation)
                for head, modulation in zip(heads, modulations, strict=True)
            )
            return velocity_BKD, noise_BKD

        return predict

    def _attention_mask(self, attended_BK: Tensor) -> Tensor:
        return self.segment.attention_mask(attended_BK, causal=self.config.segment_attention == "causal")

    def _action_states(
        self, context: Context, actions_BKD: Tensor, tau_B: Tensor, attention_mask_BTT: Tensor
    ) -> Tensor:
        """Return states (B, K, H) of noisy actions; draws of one observation do not read each other."""
        embeds_BTH = self.segment(actions_BKD, tau_B)
        draws = SideBySide(len(embeds_BTH) // len(context.pooled))
        states = self.backbone.read_segment(
            context.prefix,
            draws.joined(embeds_BTH),
            draws.attention_mask(attention_mask_BTT),
            draws.number,
        )
        return self.segment.of_actions(states.reshape(embeds_BTH.shape))

    def _pointing(self, context: Context, state_BS: Tensor) -> Context:
        """Return the context with the feedback of its pointing."""
        assert self.pointer is not None
        return replace(context, feedback=self.pointer.feed_back(self._point(context, state_BS)))

    def _point(self, context: Context, state_BS: Tensor) -> Pointed:
        """Point, from the first action's token of a chunk of zeros at tau = 0."""
        assert self.pointer is not None
        shape, device = (len(context.pooled), self.config.chunk_size, self.action_dim), self._device
        attended_BK = torch.ones(shape[:2], dtype=torch.bool, device=device)
        attention_mask_BTT = self._attention_mask(attended_BK)
        zeros = torch.zeros(shape, device=device), torch.zeros(shape[0], device=device)
        states_BKH = self._action_states(context, *zeros, attention_mask_BTT)
        return self.pointer(states_BKH[:, 0], state_BS)

    def _read(self, batch: dict[str, Tensor]) -> Context:
        """Read the prompt, once for all sampling steps."""
        return self._read_embeds(batch)[0]

    def _read_embeds(self, batch: dict[str, Tensor]) -> tuple[Context, Tensor]:
        """Read the prompt, and return its embeddings (B, L, H), too."""
        prompt = self.prompt(batch)
        embeds_BLH = self.embed(batch, prompt.ids)
        return self._context(prompt, embeds_BLH, len(self.tokens.start)), embeds_BLH

    def _context(self, prompt: TokenRows, embeds_BLH: Tensor, num_shared: int = 0) -> Context:
        """Read embedded prompts with the language model."""
        is_image_BL = prompt.ids == self.layout.image
        prefix = self.backbone.read_prefix(embeds_BLH, is_image_BL, prompt.mask, prompt.hidden, num_shared)
        pooled_BH = masked_mean_pool(prefix.hidden, self._pooled(prompt))
        return Context(prefix, pooled_BH, feedback=None)

    def _pooled(self, prompt: TokenRows) -> Tensor:
        """Return (B, L) bool, the tokens that are pooled; all of them without an instruction."""
        attention_mask_BL = prompt.attention_mask
        if self.config.reasoning_pool == "all_prefix":
            return attention_mask_BL
        index_L = torch.arange(attention_mask_BL.shape[1], device=attention_mask_BL.device)
        if self.config.reasoning_pool == "last":
            return (index_L == attention_mask_BL.shape[1] - 1).expand_as(attention_mask_BL)
        span = self.layout.spans(len(index_L))[INSTRUCTION]
        instruction_BL = attention_mask_BL & (index_L >= span.start) & (index_L < span.stop)
        return instruction_BL | (attention_mask_BL & ~instruction_BL.any(dim=1, keepdim=True))

    def embed(self, batch: dict[str, Tensor], ids_BL: Tensor) -> Tensor:
        """Embed a batch's prompts, (B, L, H), image features and state in place."""
        generator = self.generator if self.training else None
        images = [read_image(batch, key, self.config.type, self._device) for key in self._cameras]
        images = [crop(image, self.config.crop_fraction, generator) for image in images]
        features_BPH = encode_images(self.backbone, images)
        embeds_BLH = self.layout.with_images(self.backbone.embed_tokens(ids_BL), features_BPH)
        if self.state_embedding is None:
            return embeds_BLH
        state_BH = self.state_embedding(self._state(batch)).to(embeds_BLH.dtype)
        column = self.layout.spans(ids_BL.shape[1])[STATE].start
        return embeds_BLH.index_copy(1, torch.tensor([column], device=ids_BL.device), state_BH[:, None])
