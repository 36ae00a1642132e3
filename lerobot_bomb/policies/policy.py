"""The base of our policies."""

from abc import abstractmethod
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from typing import Any, ClassVar, Self

import torch
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.constants import ACTION
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel

from lerobot_bomb.actions.ensemble import TemporalEnsemble
from lerobot_bomb.actions.relative import bounds
from lerobot_bomb.checkpoints.adapters import frozen_buffers
from lerobot_bomb.data.columns import dim_names
from lerobot_bomb.decoding.kv_cache import check_positions
from lerobot_bomb.flow.noise import SamplingNoise, gumbel
from lerobot_bomb.hub.policy import HubPolicy
from lerobot_bomb.policies.config import ChunkConfig, TokenVlaConfig, VlaConfig
from lerobot_bomb.training.distributed import SavesTiedWeightsOnce
from lerobot_bomb.training.policy_flags import check_as_trained, check_weights_fit, trained_with
from lerobot_bomb.vlm.inputs import read_tensor
from lerobot_bomb.vlm.prompt import task_ids, task_text
from lerobot_bomb.vlm.tokenizer import load_tokenizer


class ChunkPolicy(HubPolicy, SavesTiedWeightsOnce, PreTrainedPolicy):
    """What a policy has that predicts chunks of actions: queue, units, checkpoints.

    Shapes: `B` batch, `T` actions of a chunk, `D` action dims.
    """

    # LeRobot asks every class for them; a policy has its own
    config_class = ChunkConfig  # pyright: ignore[reportAssignmentType]  LeRobot annotates it as None
    name = "chunk"  # pyright: ignore[reportAssignmentType]
    config: ChunkConfig
    action_unit: Tensor
    # flags that say what shapes the weights have
    shapes: ClassVar[tuple[str, ...]]
    # the same, and flags that say what the model's inputs and answers mean
    as_trained: ClassVar[tuple[str, ...]]

    def __init__(self, config: Any, dataset_meta: LeRobotDatasetMetadata | None = None, **_: object):
        super().__init__(config, dataset_meta)
        config.validate_features()
        config.trained_with = trained_with(config, self.as_trained)
        # physical size of 1 in normalised actions, and their names; known while training: (D,)
        self.register_buffer("action_unit", torch.ones(self._action_dim), persistent=False)
        self._action_names: list[str] | None = None
        if dataset_meta is not None:
            self._take_units(dataset_meta)
        # of all that is random in training
        self.generator = torch.Generator().manual_seed(torch.initial_seed())
        self._base_buffers: dict[str, Tensor] | None = None  # of the checkpoint, before it was fitted to data

    @classmethod
    def from_pretrained(
        cls, *args, config: Any = None, dataset_meta: LeRobotDatasetMetadata | None = None, **kwargs
    ) -> Self:
        """As LeRobot's, but a missing or unexpected tensor is an error; fits the data that it is given."""
        if config is not None:
            if dataset_meta is None:
                check_as_trained(config)
            else:
                check_weights_fit(config, cls.shapes)
        policy = super().from_pretrained(
            *args, config=config, dataset_meta=dataset_meta, **{**kwargs, "strict": True}
        )
        if dataset_meta is not None:
            policy._base_buffers = frozen_buffers(policy)
            policy._fit(dataset_meta)
        return policy

    def _fit(self, meta: LeRobotDatasetMetadata) -> None:
        """Take from a dataset what a checkpoint that is trained on needs to know of it."""
        self._take_units(meta)

    @torch.no_grad()
    def _take_units(self, meta: LeRobotDatasetMetadata) -> None:
        assert meta.stats is not None
        mode = self.config.normalization_mapping["ACTION"]
        low, high = bounds(meta.stats[ACTION], mode, self._action_dim)
        self.action_unit.copy_(torch.from_numpy(high - low) / 2)
        self._action_names = dim_names(meta.features[ACTION])

    def get_optim_params(self) -> list[nn.Parameter]:
        return [parameter for parameter in self.parameters() if parameter.requires_grad]

    def reset(self) -> None:
        self._queue: deque[Tensor] = deque(maxlen=self.config.n_action_steps)
        self._batch_size: int | None = None  # of the episodes that are under way

    def _check_batch_size(self, batch: dict[str, Tensor]) -> None:
        """Raise unless a batch has as many rows as the one before it since `reset`."""
        batch_size = len(batch[self._cameras[0]])
        if self._batch_size not in (None, batch_size):
            raise ValueError(
                f"a batch of {batch_size} observations follows one of {self._batch_size}, whose episodes are "
                f"under way; call policy.reset() where episodes begin"
            )
        self._batch_size = batch_size

    def _kept(self, batch: dict[str, Tensor]) -> Tensor:
        """(B, T) bool: which actions are trained on."""
        if f"{ACTION}_is_pad" in batch and not self.config.loss_on_padded_actions:
            return ~self._of_batch(batch, f"{ACTION}_is_pad").bool()
        shape = len(batch[ACTION]), self.config.chunk_size
        return torch.ones(shape, dtype=torch.bool, device=self._device)

    def _l1_parts(self, errors_BTD: Tensor, counted_BTD: Tensor) -> dict[str, tuple[Tensor, Tensor]]:
        """Absolute errors as `means` takes them, in all and by dimension; none where units are not known."""
        if self._action_names is None:
            return {}
        dims = {
            f"l1_{name}": (errors_BTD[..., dim], counted_BTD[..., dim])
            for dim, name in enumerate(self._action_names)
        }
        return {"l1": (errors_BTD, counted_BTD), **dims}

    def _of_batch(self, batch: dict[str, Tensor], key: str) -> Tensor:
        return read_tensor(batch, key, self.config.type, self._device)

    @property
    def _cameras(self) -> list[str]:
        return sorted(self.config.image_features)

    @property
    def _action_dim(self) -> int:
        assert self.config.action_feature is not None
        return self.config.action_feature.shape[0]

    @property
    def _device(self) -> torch.device:
        return self.action_unit.device


class VlaPolicy(ChunkPolicy):
    """One with a vision-language model."""

    config_class = VlaConfig  # pyright: ignore[reportAssignmentType]
    name = "vla"  # pyright: ignore[reportAssignmentType]
    config: VlaConfig

    def _check_instructions(
        self, meta: LeRobotDatasetMetadata, text_config: Any, template: str, num_others: int
    ) -> None:
        """Raise unless a dataset's instructions fit into the model's positions beside so many other tokens.

        A token is at least a byte of text, so the tokenizer is asked only if there are too many of these.
        Where it cannot be had, as in a training further without the base model, the first batch will tell.

        Raises:
            ValueError: the longest does not fit.
        """
        texts = {task: task_text(task, template) for task in (() if meta.tasks is None else meta.tasks.index)}
        longest = max(texts, key=lambda task: len(texts[task].encode()), default="")
        num_tokens = len(texts.get(longest, "").encode())
        way_out = f"shorten the dataset's instruction {longest[:40]!r}..."
        try:
            check_positions(text_config, num_others + num_tokens, way_out)
        except ValueError:
            with suppress(OSError):
                tokenizer = load_tokenizer(self.config.vlm_model_name)
                num_tokens = max(len(task_ids(tokenizer, task, template)) for task in texts)
                check_positions(text_config, num_others + num_tokens, way_out)

    @contextmanager
    def _autocast(self) -> Iterator[None]:
        """The precision of ``config.dtype``, whoever calls: training, evaluation or a user's own loop."""
        device, bfloat16 = self._device.type, self.config.dtype == "bfloat16"
        # gradients of torch's fused attention in bfloat16 take four to ten times as long on a CPU
        plain = sdpa_kernel(SDPBackend.MATH) if bfloat16 and device == "cpu" else nullcontext()
        with torch.autocast(device, dtype=torch.bfloat16, enabled=bfloat16), plain:
            yield


class TokenVlaPolicy(VlaPolicy):
    """One whose actions are tokens, which it need not write beyond those that are executed."""

    config_class = TokenVlaConfig  # pyright: ignore[reportAssignmentType]
    name = "token_vla"  # pyright: ignore[reportAssignmentType]
    config: TokenVlaConfig
    _ensemble: TemporalEnsemble | None

    def __init__(self, config: Any, dataset_meta: LeRobotDatasetMetadata | None = None, **_: object):
        super().__init__(config, dataset_meta)
        self._sampling_noise = SamplingNoise(config.noise_seed, is_per_episode=True, draw=gumbel)

    def _choice_noise(self, batch_size: int, shape: tuple[int, ...]) -> Tensor | None:
        """(B, *shape) to be added to logits, so that the likeliest choice is a sample; None: it is greedy."""
        if not self.config.temperature:
            return None
        noise = self._sampling_noise.draw(batch_size, shape)
        return self.config.temperature * noise.to(self._device)

    def _make_ensemble(self) -> TemporalEnsemble | None:
        """None: a queue instead."""
        config = self.config
        if not config.temporal_ensemble_size:
            return None
        return TemporalEnsemble(
            config.temporal_ensemble_size,
            config.temporal_ensemble_weighting,
            config.temporal_ensemble_coefficient,
            self._newest_only(),
        )

    @abstractmethod
    def _newest_only(self) -> Sequence[int]:
        """Action dims that an ensemble does not average, such as a gripper that is open or closed."""

    def reset(self) -> None:
        super().reset()
        self._sampling_noise.begin()
        if self._ensemble is not None:
            self._ensemble.reset()

    def select_action(self, batch: dict[str, Tensor]) -> Tensor:
        """(B, D) next normalised action.

        With a temporal ensemble every call predicts; else when the queue of ``n_action_steps`` is empty.

        Raises:
            ValueError: the batch has another size than the one before, and `reset` was not called in between.
        """
        self._check_batch_size(batch)
        if self._ensemble is not None:
            return self._ensemble(self._predict(batch, self.config.temporal_ensemble_size))
        if not self._queue:
            self._queue.extend(self._predict(batch, self.config.n_action_steps).unbind(dim=1))
        return self._queue.popleft()

    def predict_action_chunk(
        self,
        batch: dict[str, Tensor],
        *,
        inference_delay: int | None = None,
        prev_chunk_left_over: Tensor | None = None,
    ) -> Tensor:
        """(B, T, D) normalised actions.

        The others are what LeRobot's real-time chunking passes; a chunk of tokens is not guided by them.
        """
        return self._predict(batch, self.config.chunk_size)

    @abstractmethod
    def _predict(self, batch: dict[str, Tensor], num_steps: int) -> Tensor:
        """The first ``num_steps`` normalised actions of the chunk."""
