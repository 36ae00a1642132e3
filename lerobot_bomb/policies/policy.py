"""Base of our policies."""

from abc import abstractmethod
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.constants import ACTION, DONE, OBS_STATE
from torch import Tensor, nn

from lerobot_bomb.actions.ensemble import TemporalEnsemble
from lerobot_bomb.actions.relative import RelativeActions, Statistics, bounds, named_dims
from lerobot_bomb.actions.text import TokenRows
from lerobot_bomb.checkpoints.adapters import check_buffers_are_the_bases, frozen_buffers
from lerobot_bomb.checkpoints.folder import saved_statistics
from lerobot_bomb.checkpoints.starting import check_start
from lerobot_bomb.compat.hooks.evaluation import run_tasks_in_turn
from lerobot_bomb.data.columns import (
    check_chunk_length,
    dim_names,
    episode_bounds,
    present_episodes,
    read_columns,
    require_motion,
)
from lerobot_bomb.decoding.kv_cache import check_positions
from lerobot_bomb.flow.noise import SamplingNoise
from lerobot_bomb.hub.policy import HubPolicy
from lerobot_bomb.policies.config import ChunkConfig, VlaConfig
from lerobot_bomb.policies.relative_config import RelativeVlaConfig
from lerobot_bomb.training.distributed import SavesTiedWeightsOnce
from lerobot_bomb.training.muon import parameter_groups
from lerobot_bomb.training.policy_flags import MUON, check_as_trained, check_weights_fit, trained_with
from lerobot_bomb.training.randomness import begin_batch
from lerobot_bomb.vlm.attention import Float32Attention, warn_if_bfloat16_is_slow
from lerobot_bomb.vlm.inputs import read_state, read_task, read_tensor
from lerobot_bomb.vlm.layout import INSTRUCTION, PromptLayout
from lerobot_bomb.vlm.prompt import task_ids, task_text
from lerobot_bomb.vlm.tokenizer import load_tokenizer


def _is_chunk_policy(policy: nn.Module) -> bool:
    """Return True for a policy of chunks, and for one that adapters are wrapped around."""
    return any(isinstance(module, ChunkPolicy) for module in policy.modules())


class ChunkPolicy(HubPolicy, SavesTiedWeightsOnce, PreTrainedPolicy):
    """Base of policies that predict chunks of actions: queue, units, checkpoints.

    Shapes: `B` batch, `T` actions of a chunk, `D` action dims.
    """

    # LeRobot asks every class for them; a policy has its own
    config_class = ChunkConfig  # pyright: ignore[reportAssignmentType]  LeRobot annotates it as None
    name = "chunk"  # pyright: ignore[reportAssignmentType]
    config: ChunkConfig
    _sampling_noise: SamplingNoise | None = None  # of types that sample
    action_unit: Tensor
    # flags that say what shapes the weights have
    shapes: ClassVar[tuple[str, ...]]
    # those, and flags that say what the model's inputs and outputs mean
    as_trained: ClassVar[tuple[str, ...]]

    def __init__(self, config: Any, dataset_meta: LeRobotDatasetMetadata | None = None, **_: object):
        super().__init__(config, dataset_meta)
        run_tasks_in_turn(_is_chunk_policy)
        config.validate_features()
        config.trained_with = trained_with(config, self.as_trained)
        # (D,) physical size of 1 in normalised actions, and names of the dims; known in training only
        self.register_buffer("action_unit", torch.ones(self.action_dim), persistent=False)
        self._action_names: list[str] | None = None
        if dataset_meta is not None:
            check_chunk_length(config.chunk_size, dataset_meta)
            self._take_units(dataset_meta, _action_statistics(dataset_meta))
        # for all that is random in training
        self.generator = torch.Generator().manual_seed(torch.initial_seed())
        self._base_buffers: dict[str, Tensor] | None = None  # of the checkpoint, before it was fitted to data

    @classmethod
    def from_pretrained(
        cls,
        pretrained_name_or_path: str | Path,
        *,
        config: Any = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
        **kwargs,
    ) -> Self:
        """Load as LeRobot does, but refuse missing or unexpected tensors; fit to `dataset_meta`, if given."""
        if config is not None:
            check_start(pretrained_name_or_path, config, dataset_meta)
            cls._prepare(config, dataset_meta)
        policy = super().from_pretrained(
            pretrained_name_or_path, config=config, dataset_meta=dataset_meta, **{**kwargs, "strict": True}
        )
        if dataset_meta is not None:
            policy._base_buffers = frozen_buffers(policy)
            if policy.config.keep_statistics:
                policy._start_on(dataset_meta, saved_statistics(policy.config)[ACTION])
            else:
                policy._start_on(dataset_meta, _action_statistics(dataset_meta))
                policy._fit(dataset_meta)
        return policy

    @classmethod
    def _prepare(cls, config: Any, meta: LeRobotDatasetMetadata | None) -> None:
        """Check and complete the config of a checkpoint; `meta` is of the data to train on, if any."""
        if meta is None:
            check_as_trained(config, cls.as_trained)
        else:
            check_weights_fit(config, cls.shapes)

    def _start_on(self, meta: LeRobotDatasetMetadata, actions: Statistics) -> None:
        """Check a checkpoint's new dataset, and take what training needs and no checkpoint keeps.

        ``actions``: statistics that the processors normalise actions by, the checkpoint's or the dataset's.
        """
        check_chunk_length(self.config.chunk_size, meta)
        self._take_units(meta, actions)

    def _fit(self, meta: LeRobotDatasetMetadata) -> None:
        """Fit to a dataset and its statistics what a checkpoint keeps."""

    @torch.no_grad()
    def _take_units(self, meta: LeRobotDatasetMetadata, actions: Statistics) -> None:
        mode = self.config.normalization_mapping["ACTION"]
        low, high = bounds(actions, mode, self.action_dim)
        self.action_unit.copy_(torch.from_numpy(high - low) / 2)
        self._action_names = dim_names(meta.features[ACTION])

    def get_optim_params(self) -> list[Any]:
        if self.config.optimizer == MUON:
            return parameter_groups(self)
        return [parameter for parameter in self.parameters() if parameter.requires_grad]

    def reset(self) -> None:
        self._queue: deque[Tensor] = deque(maxlen=self.config.n_action_steps)
        self._batch_size: int | None = None  # of the episodes that are under way
        if self._sampling_noise is not None:
            self._sampling_noise.begin()

    def reset_to(self, first_episode: int) -> None:
        """Reset, to act as in a batch that begins with this episode of an evaluation."""
        self.reset()
        if self._sampling_noise is not None:
            self._sampling_noise.begin(first_episode)

    def drop_queued_actions(self) -> None:
        """Let the next `select_action` predict; LeRobot 0.6.2 calls this when the instruction changes."""
        self._queue.clear()

    def _check_batch_size(self, batch: dict[str, Tensor]) -> None:
        """Raise unless a batch has as many rows as the one before it since `reset`."""
        batch_size = len(batch[self._cameras[0]])
        if self._batch_size not in (None, batch_size):
            raise ValueError(
                f"a batch of {batch_size} observations follows one of {self._batch_size}, whose episodes are "
                f"under way; call policy.reset() where episodes begin"
            )
        self._batch_size = batch_size

    def _begin_batch(self) -> None:
        """Seed all that is random in `forward`: each batch of a training anew, all of an evaluation alike."""
        if self.training:
            begin_batch(self.config, self.generator)
        elif not torch.is_grad_enabled():  # a loop of one's own may learn in evaluation mode
            self.generator.manual_seed(torch.initial_seed())  # which may be set for each frame

    def _loss_mask(self, batch: dict[str, Tensor]) -> Tensor:
        """Return (B, T) bool, the actions that the loss counts; of a static scene only the first."""
        shape = len(batch[ACTION]), self.config.chunk_size
        is_pad_BT = torch.zeros(shape, dtype=torch.bool, device=self._device)
        if f"{ACTION}_is_pad" in batch:
            is_pad_BT = self._of_batch(batch, f"{ACTION}_is_pad").bool()
        loss_mask_BT = torch.ones_like(is_pad_BT) if self.config.loss_on_padded_actions else ~is_pad_BT
        if isinstance(done_B1 := batch.get(DONE), Tensor):
            is_later_T = torch.arange(shape[1], device=self._device) > 0
            # what follows a done frame belongs to the next scene, and so does padding beyond that
            has_next_B1 = done_B1.reshape(-1, 1).bool() & ~is_pad_BT[:, :2][:, -1:]
            loss_mask_BT = loss_mask_BT & ~(has_next_B1 & is_later_T)
        return loss_mask_BT

    def _l1_parts(self, errors_BTD: Tensor, counted_BTD: Tensor) -> dict[str, tuple[Tensor, Tensor]]:
        """Return absolute errors as `means` takes them, over all dims and by dim; {} if units are unknown."""
        if self._action_names is None:
            return {}
        dims = {
            f"l1_{name}": (errors_BTD[..., dim], counted_BTD[..., dim])
            for dim, name in enumerate(self._action_names)
        }
        return {"l1": (errors_BTD, counted_BTD), **dims}

    def _of_batch(self, batch: dict[str, Tensor], key: str) -> Tensor:
        return read_tensor(batch, key, self.config.type, self._device)

    def _state(self, batch: dict[str, Tensor]) -> Tensor:
        """Return the normalised state, (B, S)."""
        assert self.config.robot_state_feature is not None
        (num_dims,) = self.config.robot_state_feature.shape
        return read_state(batch, self.config.type, self._device, num_dims)

    @property
    def _cameras(self) -> list[str]:
        return sorted(self.config.image_features)

    @property
    def action_dim(self) -> int:
        assert self.config.action_feature is not None
        return self.config.action_feature.shape[0]

    @property
    def _device(self) -> torch.device:
        return self.action_unit.device


class VlaPolicy(ChunkPolicy):
    """Policy with a vision-language model, whose chunks are executed from a queue or as an ensemble."""

    config_class = VlaConfig  # pyright: ignore[reportAssignmentType]
    name = "vla"  # pyright: ignore[reportAssignmentType]
    config: VlaConfig
    layout: PromptLayout
    _ensemble: TemporalEnsemble | None

    def __init__(self, config: Any, dataset_meta: LeRobotDatasetMetadata | None = None, **_: object):
        is_trained = dataset_meta is not None or config.vlm_config is None
        if is_trained and config.weights_dtype != "float32":
            raise ValueError(
                f"--policy.weights_dtype={config.weights_dtype} is for the evaluation of a checkpoint; give "
                f"--policy.weights_dtype=float32"
            )
        if config.dtype == "bfloat16" and config.device == "cpu":
            warn_if_bfloat16_is_slow()
        _take_action_names(config, dataset_meta)
        super().__init__(config, dataset_meta)

    @classmethod
    def _prepare(cls, config: Any, meta: LeRobotDatasetMetadata | None) -> None:
        """Prepare as `ChunkPolicy` does, and take the names of the data's action dimensions."""
        _take_action_names(config, meta)
        super()._prepare(config, meta)

    def _check_length(
        self, text_config: Any, num_fixed: int, template: str, meta: LeRobotDatasetMetadata | None
    ) -> None:
        """Raise unless the longest prompt and answer fit into the model's positions.

        A token is at least one byte of text, so the tokenizer is loaded only if there are too many bytes.
        Where it is missing, as in further training without the base model, the first batch raises the error.

        Args:
            text_config: of the text model.
            num_fixed: tokens of everything but the instruction.
            template: how the instruction stands in the prompt.
            meta: of the dataset that is to be trained on, which has the instructions.

        Raises:
            ValueError: prompt and answer do not fit.
        """
        check_positions(text_config, num_fixed, "give a smaller --policy.chunk_size")
        if meta is None:
            return
        texts = {task: task_text(task, template) for task in ([] if meta.tasks is None else meta.tasks.index)}
        longest = max(texts, key=lambda task: len(texts[task].encode()), default="")
        num_tokens = len(texts.get(longest, "").encode())
        way_out = f"shorten the dataset's instruction {longest[:40]!r}..."
        try:
            check_positions(text_config, num_fixed + num_tokens, way_out)
        except ValueError:
            with suppress(OSError):
                tokenizer = load_tokenizer(self.config.vlm_model_name)
                num_tokens = max(len(task_ids(tokenizer, task, template)) for task in texts)
                check_positions(text_config, num_fixed + num_tokens, way_out)

    def prompt(self, batch: dict[str, Tensor]) -> TokenRows:
        """Return the tokens of everything before the answer, with padding; images are still to be put in."""
        task = read_task(batch, self.config.type, self._device)
        return self.layout.fill({INSTRUCTION: task, **self._prompt_rows(batch)})

    def _prompt_rows(self, batch: dict[str, Tensor]) -> dict[str, TokenRows]:
        """Return each row's own tokens beside its instruction's, by part of the prompt."""
        return {}

    @contextmanager
    def autocast(self) -> Iterator[None]:
        """Use the precision of ``config.dtype`` in training, in evaluation and in a user's own loop."""
        device, bfloat16 = self._device.type, self.config.dtype == "bfloat16"
        attention = Float32Attention() if bfloat16 and device == "cpu" else nullcontext()
        with torch.autocast(device, dtype=torch.bfloat16, enabled=bfloat16), attention:
            yield

    def _make_ensemble(self) -> TemporalEnsemble | None:
        """Return the temporal ensemble; None if a queue is used."""
        config = self.config
        if not config.temporal_ensemble_size:
            return None
        return TemporalEnsemble(
            config.temporal_ensemble_size,
            config.temporal_ensemble_weighting,
            config.temporal_ensemble_coefficient,
            self._newest_only(),
        )

    def _newest_only(self) -> list[int]:
        """Action dims that an ensemble does not average, such as a gripper that is open or closed."""
        config, flag = self.config, "--policy.temporal_ensemble_exclude_joints"
        return named_dims(config.action_names, config.temporal_ensemble_exclude_joints, flag)

    def reset(self) -> None:
        super().reset()
        if self._ensemble is not None:
            self._ensemble.reset()

    def drop_queued_actions(self) -> None:
        super().drop_queued_actions()
        if self._ensemble is not None:
            self._ensemble.reset()

    def select_action(self, batch: dict[str, Tensor], **options: Any) -> Tensor:
        """Return the next normalised action, (B, D); ``options`` as `_predict` takes them.

        With a temporal ensemble every call predicts; otherwise only a call that finds the queue empty.

        Raises:
            ValueError: the batch has another size than the one before, and `reset` was not called in between.
        """
        self._check_batch_size(batch)
        if self._ensemble is not None:
            return self._ensemble(self._predict(batch, self.config.temporal_ensemble_size, **options))
        if not self._queue:
            chunk_BTD = self._predict(batch, self.config.n_action_steps, **options)
            self._queue.extend(chunk_BTD.unbind(dim=1))
        return self._queue.popleft()

    def predict_action_chunk(self, batch: dict[str, Tensor], **options: Any) -> Tensor:
        """(B, T, D) normalised actions."""
        return self._predict(batch, self.config.chunk_size, **options)

    @abstractmethod
    def _predict(self, batch: dict[str, Tensor], num_steps: int, **options: Any) -> Tensor:
        """Return the first ``num_steps`` normalised actions of the chunk, (B, num_steps, D)."""


class RelativeVlaPolicy(VlaPolicy):
    """Policy whose actions may be differences to the state that a chunk starts from.

    Training targets and predictions are relative; returned actions, queue and ensemble are absolute.
    """

    config_class = RelativeVlaConfig  # pyright: ignore[reportAssignmentType]
    name = "relative_vla"  # pyright: ignore[reportAssignmentType]
    config: RelativeVlaConfig

    def __init__(self, config: Any, dataset_meta: LeRobotDatasetMetadata | None = None, **_: object):
        super().__init__(config, dataset_meta)
        self.relative = (
            RelativeActions(self.action_dim, config.relative_dims()) if config.relative_actions else None
        )
        if dataset_meta is not None:
            self._fit_relative(dataset_meta)

    @classmethod
    def from_pretrained(cls, *args: Any, **kwargs: Any) -> Self:
        """Load as `VlaPolicy` does, and fit relative actions to new data."""
        try:
            return super().from_pretrained(*args, **kwargs)
        except ValueError as error:
            if " relative." in str(error):
                raise ValueError(
                    "--policy.relative_actions is not what this checkpoint was trained with, "
                    "and cannot be changed"
                ) from error
            raise

    def _fit(self, meta: LeRobotDatasetMetadata) -> None:
        super()._fit(meta)
        self._fit_relative(meta)

    @torch.no_grad()
    def _fit_relative(self, meta: LeRobotDatasetMetadata) -> None:
        """Fit relative actions, if used, to the differences of a dataset's actions and states."""
        if self.relative is None:
            return
        config = self.config
        assert meta.stats is not None
        if OBS_STATE not in meta.features:
            raise ValueError(
                f"--policy.relative_actions=true needs {OBS_STATE!r} under this name in the dataset; it has "
                f"{sorted(meta.features)}"
            )
        if config.chunk_size > 1:
            require_motion(meta, "--policy.relative_actions=true is fitted to chunks of them")
        columns = read_columns(meta, (ACTION, OBS_STATE), present_episodes(meta))
        action_bounds, state_bounds = (
            bounds(meta.stats[key], config.normalization_mapping[kind], columns[key].shape[1])
            for key, kind in ((ACTION, "ACTION"), (OBS_STATE, "STATE"))
        )
        _, ends = episode_bounds(columns["episode_index"])
        self.relative.fit(
            columns[ACTION],
            columns[OBS_STATE],
            ends,
            config.chunk_size,
            action_bounds,
            state_bounds,
            config.normalization_mapping["ACTION"],
        )

    def _validate_peft_config(self, peft_config: Any) -> None:
        super()._validate_peft_config(peft_config)
        saved = peft_config.modules_to_save or ()
        advice = "start from one that lerobot-bomb checkpoint init writes for this dataset"
        check_buffers_are_the_bases(self, self._base_buffers, saved, advice)

    def to_relative(self, actions_BTD: Tensor, batch: dict[str, Tensor]) -> Tensor:
        """Normalised actions (B, T, D) -> the actions that are predicted, (B, T, D)."""
        if self.relative is None:
            return actions_BTD
        return self.relative.encode(actions_BTD, self._state(batch))

    def to_absolute(self, predicted_BTD: Tensor, batch: dict[str, Tensor]) -> Tensor:
        """Invert `to_relative`."""
        if self.relative is None:
            return predicted_BTD
        return self.relative.decode(predicted_BTD, self._state(batch))

    @property
    def _unit(self) -> Tensor:
        """(D,) physical size of 1 in predicted actions."""
        return self.action_unit if self.relative is None else self.action_unit * self.relative.scale


def _action_statistics(meta: LeRobotDatasetMetadata) -> Statistics:
    assert meta.stats is not None
    return meta.stats[ACTION]


def _take_action_names(config: Any, meta: LeRobotDatasetMetadata | None) -> None:
    """Take the dataset's names of action dims as one list; LeRobot keeps only the groups of grouped names."""
    if config is not None and meta is not None:
        config.action_feature_names = dim_names(meta.features[ACTION])
