"""Common parts of the recordings of all environments."""

import itertools
import json
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

from lerobot_bomb.data.resumable import check_repo_id
from lerobot_bomb.data.rollout_pool import Rollouts
from lerobot_bomb.envs.rollout import Expert

if TYPE_CHECKING:
    from lerobot_bomb.data.blocks import DatasetLayout

MAX_NOISE = 1.0  # beyond it the noise exceeds the largest action


@dataclass(frozen=True)
class BaseRecording(ABC):
    """Parameters that determine a recording frame by frame."""

    kind: ClassVar[str] = "recording"

    repo_id: str
    episodes: int
    seed: int = 0

    def _check(self, perturbations: Sequence[str], noise: float) -> None:
        """Raise a ValueError for a wrong flag of those that every recording has."""
        check_repo_id(self.repo_id)
        if self.episodes < 1:
            raise ValueError(f"--episodes={self.episodes} must be at least 1")
        if not perturbations:
            raise ValueError('--env.perturbations=[] names no condition; leave it out or give ["none"]')
        if not 0 <= noise <= MAX_NOISE:
            raise ValueError(
                f"--noise={noise} must lie in 0..{MAX_NOISE:g}; "
                "it is a standard deviation in units of the largest step"
            )

    def to_dict(self) -> dict[str, Any]:
        """Return the recording as JSON values."""
        return json.loads(json.dumps(asdict(self)))

    @property
    def scenes(self) -> int:
        """Number of seeds that an episode takes: that of its static scenes; 1 without scenes."""
        return 1

    @property
    @abstractmethod
    def conditions(self) -> list[Any]:
        """Return the specs that every seed is run with; they hold the first seed."""

    def specs(self, num_tried: int) -> Iterator[Any]:
        """Yield the episodes to try after the first `num_tried`: seeds count up, each with all conditions."""
        conditions = self.conditions
        for tried in itertools.count(num_tried):
            seeds_done, condition = divmod(tried, len(conditions))
            yield replace(conditions[condition], seed=self.seed + seeds_done * self.scenes)

    @abstractmethod
    def rollouts(self, expert: Expert) -> Rollouts:
        """Return how the episodes are run."""

    @abstractmethod
    def layout(self) -> "DatasetLayout":
        """Return the layout of the dataset."""

    def flag_names(self) -> AbstractContextManager[None]:
        """Name flags in errors as they were given."""
        return nullcontext()
