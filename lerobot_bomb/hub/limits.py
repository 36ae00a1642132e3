"""Limits of a checkpoint, as far as its config, its trainings and its results show them."""

from collections.abc import Iterator, Sequence

from lerobot_bomb.bomb.environment import Environment
from lerobot_bomb.hub.history import History
from lerobot_bomb.hub.markdown import plain
from lerobot_bomb.hub.rates import mostly_failing
from lerobot_bomb.results.groups import Group

MAX_CONDITIONS = 10


def limits(
    environment: Environment | None, history: History, groups: Sequence[Group], is_small: bool
) -> Iterator[str]:
    """Yield what a checkpoint cannot do, or what is not known of it, as Markdown."""
    if environment is not None:
        yield f"It acts only in the environment of its training: {plain(str(environment))}."
    else:
        yield "It acts only where cameras, state and actions are those of its training."
    if is_small:
        yield (
            "Its model is small and was never trained on anything else: it knows no words and no objects but "
            "those of its data. It tells nothing of what the policy type does with a pretrained backbone."
        )
    if history.showed_only_nominal:
        yield "No training showed it perturbed scenes."
    if not groups:
        yield "How often it succeeds is not known: no evaluation is attached."
    if failing := mostly_failing(groups):
        more = f" and {len(failing) - MAX_CONDITIONS} more" if len(failing) > MAX_CONDITIONS else ""
        yield f"It fails more often than not under {', '.join(failing[:MAX_CONDITIONS])}{more}."
    if groups:
        yield "The rates are those of one training; another one's may differ by more than the intervals."
    if environment is not None or groups:
        yield "Everything here was measured in simulation, nothing on a robot."
