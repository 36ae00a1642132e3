"""Sentences about how episodes ended: as recorded, without a perturbation, with something hidden or reworded.

They read the values of `explanation.json`.
"""

from collections import Counter
from collections.abc import Mapping, Sequence

from lerobot_bomb.bomb.episode import COLLATERAL_TOLERANCE_MM, Failure
from lerobot_bomb.conditions import NONE
from lerobot_bomb.explain.effects import Values
from lerobot_bomb.explain.limits import MAX_NAMES
from lerobot_bomb.explain.mask_names import NOTHING, is_hidden, subject
from lerobot_bomb.results.bomb import PUT_DOWN
from lerobot_bomb.results.summary import named_counts
from lerobot_bomb.stats import format_rate
from lerobot_bomb.tables import first_of, in_a_row

WHATEVER = "Whatever single input is hidden in every step"
# what happened, by failure class of BOMB
HAPPENED = {
    Failure.NEVER_REACHED: "the gripper never came to the stone",
    Failure.MISSED_GRASP: "it came to the stone, but never lifted it",
    Failure.DROPPED: "it lifted the stone and let it fall",
    Failure.WRONG_STONE: "it took another stone than the one that is meant",
    Failure.WRONG_INTERSECTION: "it put the stone down in the wrong place",
    Failure.IMPRECISE: "it put the stone down at the right intersection, but not precisely",
    Failure.DISTURBED_OTHERS: "its stone is in place, but it moved another one",
    Failure.TIMEOUT_HOLDING: "it had not let go of the stone when time ran out",
    Failure.LIFTED: "it lifted a stone that is to be slid",
}


def outcome(result: Values) -> str:
    """Return how an episode ended: class, what it means, where the stone lies, what else was moved."""
    ending = _ending(result)
    facts = [HAPPENED.get(result["failure"], ""), *_distances(result)]
    told = "; ".join(each for each in facts if each)
    return f"{ending}: {told}." if told else f"{ending}."


def _ending(result: Values) -> str:
    name = "It succeeded" if result["is_success"] else f"It failed ({result['failure']})"
    return name + _after(result)


def _after(result: Values) -> str:
    return f" after {result['steps']} steps" if "steps" in result else ""


def _distances(result: Values) -> list[str]:
    """Return where the stone is and how far another one was moved, of BOMB."""
    if "placement_error_mm" not in result:
        return []
    error_mm, moved_mm = result["placement_error_mm"], result["collateral_mm"]
    target = "its target" if result["target"] is None else _intersection(result["target"])
    nearest = _intersection(result["nearest_intersection"])
    is_elsewhere = not result["is_success"] and result["failure"] in PUT_DOWN and nearest != target
    beside = f", nearest to {nearest}" if is_elsewhere else ""
    found = [f"the stone is {error_mm:.1f} mm from {target}{beside}"]
    if moved_mm > COLLATERAL_TOLERANCE_MM:
        allowed = f"{COLLATERAL_TOLERANCE_MM:.0f} mm are allowed"
        found.append(f"another stone was moved {moved_mm:.1f} mm ({allowed})")
    return found


def _intersection(place: Sequence[int]) -> str:
    row, column = place
    return f"row {row}, column {column}"


def count_outcomes(results: Sequence[Values]) -> str:
    """Return how often episodes succeeded, and the classes of the others."""
    failures = Counter(each["failure"] for each in results if not each["is_success"])
    rate = format_rate(len(results) - failures.total(), len(results))
    return f"Success: {rate}{f'; failures: {named_counts(failures)}' if failures else ''}."


def as_recorded(result: Values, recorded: Values | None) -> list[str]:
    """Return a sentence if the episode ended otherwise than its record says."""
    # a policy that draws noise may fail alike, but at another time and place
    if recorded is None or all(recorded.get(name) == result.get(name) for name in ("failure", "steps")):
        return []
    then = (recorded["failure"] or "success") + _after(recorded)
    return [f"In its record it ended otherwise ({then}): what follows is about the run shown here."]


def without_perturbations(counterfactuals: Sequence[Values]) -> list[str]:
    """Return what the same seed without some of its perturbations says."""
    if not counterfactuals:
        return []
    clean = next(each for each in counterfactuals if each["perturbations"] == NONE)
    single = [each for each in counterfactuals if len(each["without"]) == 1]
    helped = [each for each in single if each["result"]["is_success"]]
    if helped:
        ways = [f'"{each["without"][0]}"{_steps(each["result"])}' for each in helped]
        others = "; leaving out any other does not help" if len(helped) < len(single) else ""
        return [f"The same seed succeeds without axis {in_a_row(ways, 'or')}{others}."]
    if clean["result"]["is_success"]:
        told = f"The same seed succeeds unperturbed{_steps(clean['result'])}"
        return [f"{told}, but without any single perturbation it fails too: they break it together."]
    failure = clean["result"]["failure"]
    return [f"The perturbations are not the reason: the same seed unperturbed fails too ({failure})."]


def _steps(result: Values) -> str:
    return f" (in {result['steps']} steps)" if "steps" in result else ""


def turned_right(result: Values, masked: Mapping[str, Values]) -> list[str]:
    """Return which hidden inputs lead a failed episode's stone to the right place."""
    succeeded, right = turning(result, masked)
    told = [f"With {_any_of(succeeded)} hidden in every step, it succeeds."] if succeeded else []
    if right:
        there = _intersection(result["target"])
        where = f"the stone is put down at the right intersection, {there}"
        if result["failure"] in PUT_DOWN:
            where += f", not at {_intersection(result['nearest_intersection'])}"
        failures = in_a_row(list(dict.fromkeys(masked[name]["failure"] for name in right)))
        where += f", though the episode still fails ({failures})"
        told.append(f"With {_any_of(right)} hidden in every step, {where}.")
    return told


def turning(result: Values, masked: Mapping[str, Values]) -> tuple[list[str], list[str]]:
    """Return the masks under which a failed episode succeeds, and those that only turn it to its target.

    A mask that names another target is none of them: what was asked for first is then the wrong place.
    """
    if result["is_success"]:
        return [], []
    masked = {name: each for name, each in masked.items() if is_hidden(name)}
    succeeded = [name for name, each in masked.items() if each["is_success"]]
    others = [] if _is_at_target(result) else [name for name in masked if name not in succeeded]
    return succeeded, [name for name in others if _is_at_target(masked[name])]


def _is_at_target(result: Values) -> bool:
    """Return True if the stone was put down nearest to the intersection that was named."""
    if result.get("target") is None or result["failure"] not in PUT_DOWN:
        return False
    return tuple(result["nearest_intersection"]) == tuple(result["target"])


def _any_of(masks: Sequence[str]) -> str:
    """Return "the stone or the word for row"."""
    return in_a_row(first_of([*map(subject, masks)], MAX_NAMES), "or")


def with_masks(masked: Mapping[str, Values]) -> list[str]:
    """Return which hidden inputs make a success fail; of a failure, that none changes where it ends."""
    clean = masked.get(NOTHING)
    if clean is None:
        return []
    if not clean["is_success"]:
        return [] if any(turning(clean, masked)) else [f"{WHATEVER}, it still fails."]
    needed = needed_masks(masked)
    if not needed:
        return [f"{WHATEVER}, it still succeeds."]
    return [f"It fails if any one of these is hidden in every step: {', '.join(map(subject, needed))}."]


def felt_masks(masked: Mapping[str, Values]) -> list[str]:
    """Return the masks under which the episode ends otherwise than with nothing hidden."""
    clean = masked.get(NOTHING)
    return [] if clean is None else [name for name, each in masked.items() if _end(each) != _end(clean)]


def _end(result: Values) -> tuple[str | None, tuple[int, ...]]:
    return result["failure"], tuple(result.get("nearest_intersection") or ())


def needed_masks(masked: Mapping[str, Values]) -> list[str]:
    """Return the masks that hide what a success needs."""
    if NOTHING not in masked or not masked[NOTHING]["is_success"]:
        return []
    return [name for name, each in masked.items() if is_hidden(name) and not each["is_success"]]
