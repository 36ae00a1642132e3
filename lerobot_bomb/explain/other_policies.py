"""Policies that are not ours, scored for explanations.

Shapes: `B` rows, `J` draws of noise and time, `K` actions of a chunk, `D` action dims.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, ClassVar

import torch
from lerobot.utils.constants import ACTION, OBS_LANGUAGE_ATTENTION_MASK
from torch import Tensor, nn
from torch.nn.functional import pad

from lerobot_bomb.explain.scored_policy import Batch, DecoderLayer, Rows, ScoredPolicy, decoder_layers, some

NUM_DRAWS = 8  # of noise and time; times in the middle of as many equal parts of [0, 1]
SEED = 0


def scored(policy: Any, postprocess: Callable[[Tensor], Tensor]) -> ScoredPolicy:
    """Wrap a policy for scoring: ours by its own method, LeRobot's flow policies by loss, others by distance.

    ``postprocess``: (B, D) actions -> the same in physical units.
    """
    if hasattr(policy, "scored"):
        return policy.scored()
    model = getattr(policy, "model", None)
    if hasattr(model, "sample_noise") and hasattr(model, "sample_time"):
        return ScoredByLoss(policy)
    return ScoredByDistance(policy, postprocess)


class _ScoredByBatch(ScoredPolicy):
    """Policy whose rows are the batch's tensors as they are."""

    def __init__(self, policy: Any):
        self._policy = policy

    def encode(self, batch: Batch) -> Rows:
        return {key: value for key, value in batch.items() if isinstance(value, Tensor) and value.ndim}

    def hide(self, rows: Rows, hidden_BS: Tensor) -> Rows:
        if OBS_LANGUAGE_ATTENTION_MASK not in rows:
            raise ValueError(f"{self._policy.config.type} reads no instruction, so none of it can be hidden")
        rows = {key: value.expand(len(hidden_BS), *value.shape[1:]) for key, value in rows.items()}
        mask_BS = rows[OBS_LANGUAGE_ATTENTION_MASK].bool()
        hidden_BS = pad(hidden_BS, (0, mask_BS.shape[1] - hidden_BS.shape[1])).to(mask_BS.device)
        return rows | {OBS_LANGUAGE_ATTENTION_MASK: mask_BS & ~hidden_BS}

    def hide_in(self, batch: Batch, hidden_S: Tensor) -> Batch:
        return {**batch, **self.hide(self.encode(batch), hidden_S[None])}


class ScoredByLoss(_ScoredByBatch):
    """A flow policy whose model draws noise and time by itself: ``smolvla``, ``pi0``.

    The score is minus the loss of the clean chunk, (1, K, D), under the same draws for all rows.
    """

    unit: ClassVar[str] = "loss"

    def __init__(self, policy: Any):
        super().__init__(policy)
        self.layers = _language_layers(policy)

    @torch.no_grad()
    def answer(self, batch: Batch) -> Tensor:
        self._policy.eval()
        self._policy.reset()
        with _seeded():
            return self._policy.predict_action_chunk(batch)

    def score(self, rows: Rows, answer: Tensor) -> Tensor:
        policy = self._policy.eval()
        num_rows = len(next(iter(rows.values())))
        batch = {key: value.repeat_interleave(NUM_DRAWS, dim=0) for key, value in rows.items()}
        batch[ACTION] = answer.expand(num_rows * NUM_DRAWS, -1, -1)
        with _same_draws(policy.model, num_rows):
            losses, _ = policy.forward(batch, reduction="none")
        return -losses.float().unflatten(0, (num_rows, NUM_DRAWS)).mean(dim=1)


class ScoredByDistance(_ScoredByBatch):
    """Any policy, scored by minus the mean distance of executed actions (1, T, D) from the clean ones.

    Rows are scored one by one, each from a fresh start and with the same random numbers.
    """

    unit: ClassVar[str] = "distance of actions"

    def __init__(self, policy: Any, postprocess: Callable[[Tensor], Tensor]):
        super().__init__(policy)
        self._postprocess = postprocess
        self._num_steps = getattr(policy.config, "n_action_steps", 1)

    @torch.no_grad()
    def answer(self, batch: Batch) -> Tensor:
        policy = self._policy.eval()
        policy.reset()
        with _seeded():
            actions = [policy.select_action(dict(batch)) for _ in range(self._num_steps)]
        return self._postprocess(torch.cat(actions))[None]

    def score(self, rows: Rows, answer: Tensor) -> Tensor:
        num_rows = len(next(iter(rows.values())))
        answers = torch.cat([self.answer(some(rows, row, row + 1)) for row in range(num_rows)])
        return -(answers - answer).abs().float().mean(dim=(1, 2))


def _language_layers(policy: nn.Module) -> list[DecoderLayer]:
    """Return the layers of a policy's first language model; its parts are taken to be called one by one."""
    for module in policy.modules():
        layers = getattr(module, "layers", None)
        first = layers[0] if isinstance(layers, nn.ModuleList) and len(layers) else None
        if hasattr(first, "mlp") and hasattr(getattr(first, "self_attn", None), "o_proj"):
            return decoder_layers(module, called_whole=False)
    return []


@contextmanager
def _seeded() -> Iterator[None]:
    with torch.random.fork_rng():
        torch.manual_seed(SEED)
        yield


@contextmanager
def _same_draws(model: Any, num_rows: int) -> Iterator[None]:
    """Let a flow model draw the same noise for each row; each is repeated NUM_DRAWS times."""

    def sample_noise(shape: tuple[int, ...], device: torch.device | str) -> Tensor:
        draws = torch.randn((NUM_DRAWS, *shape[1:]), generator=torch.Generator().manual_seed(SEED))
        return draws.repeat(num_rows, *[1] * (draws.ndim - 1)).to(device)

    def sample_time(_: int, device: torch.device | str) -> Tensor:
        return ((torch.arange(NUM_DRAWS) + 0.5) / NUM_DRAWS).repeat(num_rows).to(device)

    model.sample_noise, model.sample_time = sample_noise, sample_time
    try:
        yield
    finally:
        del model.sample_noise, model.sample_time  # those of the class are left
