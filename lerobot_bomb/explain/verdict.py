"""Verdict: what an explanation found, in sentences with their evidence.

It reads the values of `explanation.json`, of one episode or of several.
"""

from collections.abc import Iterator, Sequence

from lerobot_bomb.bomb.board import HALVES
from lerobot_bomb.explain.aggregate import means_of
from lerobot_bomb.explain.effects import (
    BOTH,
    OBJECTS,
    PATCHES,
    PLACE,
    WORDS,
    Effect,
    Values,
    by_phase,
    effects_of,
    known,
)
from lerobot_bomb.explain.facts import (
    as_recorded,
    count_outcomes,
    felt_masks,
    outcome,
    turned_right,
    with_masks,
    without_perturbations,
)
from lerobot_bomb.explain.limits import MAX_NAMES, RESTORES, SHARE, SMALLEST_MM, smallest_drop
from lerobot_bomb.explain.mask_names import HIDDEN_WORDS, OBJECT, mask_name, word_name
from lerobot_bomb.tables import first_of, in_a_row

STONE, BOARD_ITSELF = "stone", "board"


def verdict(episodes: Sequence[Values]) -> list[str]:
    """Return the sentences about one episode, or about several together."""
    moments = [moment for each in episodes for moment in each["moments"]]
    felt = felt_masks(episodes[0].get("masked_episodes", {})) if len(episodes) == 1 else []
    return [*_endings(episodes), *reasons(moments, felt)]


def _endings(episodes: Sequence[Values]) -> Iterator[str]:
    if len(episodes) > 1:
        yield count_outcomes([each["result"] for each in episodes])
        return
    (episode,) = episodes
    masked = episode.get("masked_episodes", {})
    yield outcome(episode["result"])
    yield from as_recorded(episode["result"], episode.get("recorded"))
    yield from without_perturbations(episode.get("counterfactuals", ()))
    yield from turned_right(episode["result"], masked)
    yield from with_masks(masked)


def reasons(moments: Sequence[Values], felt: Sequence[str] = ()) -> list[str]:
    """Return what the policy's actions depend on in these moments, sentence by sentence.

    `felt`: masks that change how the episode ends. Of what they hide it is not said that it has no effect.
    """
    objects, patches = _distinct(effects_of(moments, OBJECTS)), effects_of(moments, PATCHES)
    steps = "the one step examined" if len(moments) == 1 else f"the {len(moments)} steps examined"
    seen = _objects(objects, steps, felt) if objects else _patches(patches)
    words = _words(effects_of(moments, WORDS), objects or patches, felt)
    return [*seen, *words, *_followed(moments), *_pointing(moments), *_heads(moments)]


def _distinct(objects: Sequence[Effect]) -> list[Effect]:
    """Leave one of the board and its halves: a half that matters as much as all of it, else the board."""
    halves = [each for each in objects if each.name in HALVES and each.matters]
    board = next((each for each in objects if each.name == BOARD_ITSELF), None)
    if board is None or not halves:
        return [each for each in objects if each.name not in HALVES]
    shown = halves[0] if halves[0].size >= board.size or not board.matters else board
    return [each for each in objects if each is shown or each.name not in (BOARD_ITSELF, *HALVES)]


def _parts(name: str) -> tuple[str, ...]:
    """Return the objects that are hidden with one: the board's halves with the board."""
    return (name, *HALVES) if name == BOARD_ITSELF else (name,)


def _changed(effect: Effect) -> str:
    """Return what changes, such as "changes the next action by at most 0.3 mm"."""
    if effect.unit == "mm":
        return f"changes the next action by at most {effect.amount}"
    return f"lowers the score of its answer by at most {effect.amount}"


def _thing(name: str) -> str:
    return {"target": "the target intersection", "other stones": "the other stones"}.get(name, f"the {name}")


def _objects(effects: Sequence[Effect], steps: str, felt: Sequence[str]) -> Iterator[str]:
    """Yield what it looks at and what it never looked at; the latter first if that is the stone."""
    used = [each for each in effects if each.matters]
    unsure = [each for each in effects if each.is_open]
    unused = sorted(
        [
            each
            for each in effects
            if not each.matters
            and not each.is_open
            and not any(mask_name(OBJECT, name) in felt for name in _parts(each.name))
        ],
        key=lambda each: each.name != STONE,
    )
    if not used:
        nothing = f"It looks at nothing in its images: hiding any one thing {_changed(effects[0])}."
        yield _open(unsure) if unsure else nothing
        return
    looks = _listed([f"{_thing(each.name)} ({each.evidence})" for each in used])
    measured = "the next action moves" if used[0].unit == "mm" else "the score of its answer drops"
    first = f"It looks at {looks}: so much {measured} when that is hidden."
    never = ""
    if unused:
        names = _listed([_thing(each.name) for each in unused])
        largest = _changed(max(unused, key=lambda each: each.size))
        it = "it" if len(unused) == 1 else "any of these"
        beside = f"hiding {_thing(used[0].name)} by {used[0].evidence}"
        never = f"In {steps}, it never looked at {names}: hiding {it} {largest}, {beside}."
    is_blind = bool(unused) and unused[0].name == STONE
    yield from (each for each in ((never, first) if is_blind else (first, never)) if each)
    if unsure:
        yield _open(unsure)


def _open(effects: Sequence[Effect]) -> str:
    """Say of objects or words that these episodes are too few to tell."""
    names = [word_name(each.name) if each.kind == WORDS else _thing(each.name) for each in effects]
    told = [f"{name} ({each.evidence})" for name, each in zip(names, effects, strict=True)]
    return f"No effect is shown, nor excluded, of {_listed(told)}."


def _patches(effects: Sequence[Effect]) -> Iterator[str]:
    used = [each for each in effects if each.matters]
    if len(used) > 1:
        most = f"most of all {used[0].name} ({used[0].evidence})"
        yield f"{len(used)} of {len(effects)} image patches matter, {most}."
    elif used:
        yield f"Of all image patches, only {used[0].name} matters ({used[0].evidence})."
    elif effects:
        yield f"No single patch of its images matters: hiding one {_changed(effects[0])}."


def _words(effects: Sequence[Effect], seen: Sequence[Effect], felt: Sequence[str]) -> Iterator[str]:
    """Yield which words decide; `seen`: the effects of what is in the images."""
    if not effects:
        yield "It reads no instruction."
        return
    used = {each.name: each for each in effects if each.matters}
    unsure = [each for each in effects if each.is_open]
    if not used and unsure:
        yield _open(unsure)
        return
    if not used:
        largest = _changed(effects[0])
        yield f"It does not read the instruction: hiding or changing any of its words {largest}."
        return
    if used.keys() & {*PLACE}:  # the words for both say nothing more
        used.pop(BOTH, None)
    told = _listed([f"{word_name(each.name)} ({each.evidence})" for each in used.values()])
    verb = "decides" if len(used) == 1 and BOTH not in used else "decide"
    unread = [
        word_name(each.name)
        for each in effects
        if not each.matters and not each.is_open and each.name != BOTH
        if mask_name(HIDDEN_WORDS, each.name) not in felt
    ]
    rest = ""
    if unread and any(each.name.startswith('"') for each in effects):  # each word by itself
        rest = "; no other word does"
    elif unread:
        rest = f"; {_listed(unread)} {'does' if len(unread) == 1 else 'do'} not"
    only = "only " if len(used) == 1 else ""
    yield f"Of the instruction, {only}{told} {verb}{_weakly([*used.values()], seen)}{rest}."


def _weakly(used: Sequence[Effect], seen: Sequence[Effect]) -> str:
    most = max((each.size for each in seen), default=0.0)
    return ", though weakly beside what it sees" if used[0].size < SHARE * most else ""


def _followed(moments: Sequence[Values]) -> Iterator[str]:
    """Yield how far the next action turns to another target that the sentence names."""
    found: dict[str, Effect] = {}
    for phase, of_phase in by_phase(moments):
        rows = [
            {word: each["along_mm"] for word, each in moment.get("following", {}).items() if word in PLACE}
            for moment in of_phase
        ]
        for word, mean in means_of(known(rows)).items():
            if mean.value > max(SMALLEST_MM, found[word].mean.value if word in found else 0.0):
                found[word] = Effect(WORDS, f"another {word}", phase, mean, "mm", True)
    if found:
        told = _listed([f"{each.evidence} for {each.name}" for each in found.values()])
        yield f"Told of another place, the next action moves towards it: {told}."


def _pointing(moments: Sequence[Values]) -> Iterator[str]:
    """Yield where it points wrongly, or does not act on what it points at."""
    checks = [(each["phase"], each["pointing"]) for each in moments if "pointing" in each]
    wrong = [(phase, each) for phase, each in checks if each["place"] != each["meant_place"]]
    right = [(phase, each) for phase, each in checks if each["place"] == each["meant_place"]]
    idle = [phase for phase, each in right if not each["goes_there"]]
    if wrong:
        told = [f"{each['place']}, not {each['meant_place']} (at {phase})" for phase, each in wrong]
        yield f"It misreads the place in {len(wrong)} of {len(checks)} moments: it points at {_listed(told)}."
    if idle:
        told = f"{len(idle)} of {len(right)} moments (at {_listed([*dict.fromkeys(idle)])})"
        yield f"It points at the place that is meant, but its next action does not go there, in {told}."
    if checks and not wrong and not idle:
        yield "It points at the place that is meant, and its next action goes there."


def _heads(moments: Sequence[Values]) -> Iterator[str]:
    """Yield the heads that alone bring back what another instruction takes away."""
    drop, phase, ratios = max(map(_restored, by_phase(moments)), key=lambda each: each[0])
    found = {name: ratio for name, ratio in ratios.items() if ratio >= RESTORES}
    names = sorted(found, key=lambda name: -found[name])
    if not names or drop == 0:
        return
    told = _listed([f"{name} ({found[name]:.0%})" for name in names])
    at = f" at {phase}" if phase else ""
    if len(names) == 1:
        yield f"One head alone carries the instruction{at}: {told} of its effect comes back with it."
    else:
        yield f"{len(names)} heads each carry the instruction{at}: {told} of its effect comes back with each."


def _restored(phase_moments: tuple[str, list[Values]]) -> tuple[float, str, dict[str, float]]:
    """Return mean drop after another instruction, the phase, and what each head brings back of it."""
    phase, moments = phase_moments
    found = [
        restored
        for moment in moments
        for restored in moment["restored"]
        if "instruction" in restored["corruption"] and _is_felt(restored, moment)
    ]
    rows = [
        {
            f"layer {layer}, head {head}": ratio
            for layer, heads in enumerate(restored["heads"])
            for head, ratio in enumerate(heads)
        }
        for restored in found
    ]
    drop = sum(abs(each["drop"]) for each in found) / len(found) if found else 0.0
    return drop, phase, {name: mean.value for name, mean in means_of(known(rows)).items()}


def _is_felt(restored: Values, moment: Values) -> bool:
    """Return True if a corruption changes the next action, or where that is no distance, the score."""
    if restored["moved_mm"] is not None:
        return restored["moved_mm"] > SMALLEST_MM
    return abs(restored["drop"]) > smallest_drop(moment["clean_score"])


def _listed(names: Sequence[str]) -> str:
    """Join names as "a, b and c", at most a few."""
    return in_a_row(first_of(names, MAX_NAMES))
