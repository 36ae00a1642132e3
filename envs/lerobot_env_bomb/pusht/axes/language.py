"""Perturbation axis `language`: the same instruction in other words."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from lerobot_bomb.pusht.perturbations import pusht_magnitude
from lerobot_env_bomb.pusht.board import PushTTransform

# Forms 1 to 5; {where} is the axis `goal`'s text on the target, else nothing.
FORMS = (
    (  # a paraphrase
        "Please push the T-shaped block to the T-shaped target{where}.",
        "Move the T-shaped block until it lies on the T-shaped target{where}.",
        "The T-shaped block belongs on the T-shaped target{where}. Push it there.",
    ),
    (  # other words, other order
        "Onto the green outline{where}: push the tee until it fits.",
        "Slide the big letter over its green print{where}.",
        "Where there is a green T{where} the block should lie; shove it there.",
    ),
    (  # clauses that distract
        "Not into a corner: push the T-shaped block onto the T-shaped target{where}.",
        "There are four walls. Never mind them and push the T-shaped block onto the T-shaped target{where}.",
        "The round one can stay anywhere. What counts is that the T-shaped block is pushed onto the T-shaped "
        "target{where}.",
    ),
    (  # another way to name block and target
        "Cover the green letter{where} with the only thing here that has its shape.",
        "Bring bar over bar and stem over stem: the loose letter onto the painted one{where}.",
        "What can be pushed is to hide what is painted green{where}.",
    ),
    (  # both, and what is not meant
        "Not beside it and not across it: when you have finished, nothing of the green letter{where} is to "
        "be seen below the loose one.",
        "The disc is you, the walls stay where they are. Of the two letters, take the loose one to the "
        "painted one{where}, never the other way round, and align bar and stem.",
    ),
)


@dataclass(frozen=True)
class PushTWording(PushTTransform):
    """Another template for the episode's instruction."""

    template: str

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: Any) -> Self:
        templates = FORMS[int(pusht_magnitude("language", "form", level)) - 1]
        return cls(templates[rng.integers(len(templates))])

    def reword(self, instruction: str, nominal: Any) -> str:
        return self.template if instruction else ""
