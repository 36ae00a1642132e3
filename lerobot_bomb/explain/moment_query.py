"""Query about one moment of an episode, and names of what the policy sees."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from lerobot.utils.constants import OBS_IMAGES
from torch import Tensor

from lerobot_bomb.explain.scored_policy import Batch
from lerobot_bomb.explain.spans import Range, Span

OBSERVATION = "observation"


@dataclass(frozen=True)
class MomentQuery:
    """Query about a moment: changes to make, one by one, to measure their effects."""

    grid: int  # cells along a side of each image
    fill: str  # of FILLINGS
    spans: Sequence[Span]  # of the instruction
    offsets: Sequence[Range]  # of its tokens, as `token_offsets` gives them; () without an instruction
    others: Mapping[str, str] = field(default_factory=dict)  # other instructions, by what they change
    # {key of an image: {what: (H, W) bool}}
    objects: Mapping[str, Mapping[str, Tensor]] = field(default_factory=dict)
    # images (1, 3, H, W) and state of another episode's moment; {}: none is at hand
    other_scene: Batch = field(default_factory=dict)


def camera_name(key: str) -> str:
    """Return 'workspace' for 'observation.images.workspace'."""
    return key.removeprefix(f"{OBS_IMAGES}.").removeprefix(f"{OBSERVATION}.")
