"""Paraphrases of LIBERO's instructions.

LIBERO's 130 instructions are one or two orders joined by "and": pick up and place, put, push, stack, open,
close, turn on, turn off. Things and places keep their names; verbs and order change.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

VERBS = ("pick up", "put", "place", "push", "stack", "open", "close", "turn on", "turn off")
ORDER = re.compile(rf"({'|'.join(VERBS)}) (.+)")
NEXT_ORDER = re.compile(rf" and (?=(?:{'|'.join(VERBS)}) )")
# the place begins at the last of these words; for a stack, at the first "on"
PLACE = re.compile(r"(.+) ((?:on|in|to|under) .+|inside)")
STACK_PLACE = re.compile(r"(.+?) (on .+)")
STATES = {"open": "open", "close": "closed", "turn on": "turned on", "turn off": "turned off"}
DONE = {"put": "put", "place": "put", "pick up": "put", "push": "pushed", "stack": "stacked"}


@dataclass(frozen=True)
class Order:
    """One thing to be done: "put", "the bowl", "on the plate"; without a place: "open", "the microwave".

    For an object that is picked up, the place is its target.
    """

    verb: str
    thing: str
    place: str = ""

    @property
    def outcome(self) -> str:
        """State after the order is carried out, in words: "the bowl has been put on the plate"."""
        thing = {"them": "both"}.get(self.thing, self.thing)
        is_plural = thing.startswith("both")
        if self.verb in STATES:
            return f"{thing} {'are' if is_plural else 'is'} {STATES[self.verb]}"
        return f"{thing} {'have' if is_plural else 'has'} been {DONE[self.verb]} {self.place}"

    def said(self, verbs: Mapping[str, str]) -> str:
        """Reword it with other verbs: {"put": "set", "turn on": "switch|on"}, the last around the thing."""
        verb, _, particle = verbs.get(self.verb, self.verb).partition("|")
        if self.verb == "pick up":
            return f"{verb} {self.thing} and {verbs.get('place', 'place')} it {self.place}"
        return " ".join(word for word in (verb, self.thing, particle, self.place) if word)


def orders_of(instruction: str) -> list[Order]:
    """Return the orders of an instruction, one after the other.

    Raises:
        ValueError: the instruction has another form than LIBERO's.
    """
    orders: list[Order] = []
    for part in NEXT_ORDER.split(instruction):
        match = ORDER.fullmatch(part)
        if match is None:
            raise ValueError(f"{instruction!r} is not worded as LIBERO's instructions are")
        verb, thing, place = match[1], match[2], ""
        if verb not in STATES and verb != "pick up":
            where = (STACK_PLACE if verb == "stack" else PLACE).fullmatch(thing)
            if where is None:
                raise ValueError(f"{instruction!r} does not say where to {verb} something as LIBERO's do")
            thing, place = where[1], where[2]
        if orders and orders[-1].verb == "pick up" and thing == "it":
            orders[-1] = replace(orders[-1], place=place)
        elif verb in STATES and thing == "it":
            # "close it" after "put the mug in the microwave"
            orders.append(Order(verb, re.sub(r"^in ", "", orders[-1].place)))
        else:
            orders.append(Order(verb, thing, place))
    return orders


def reworded(instruction: str, form: int, variant: int) -> str:
    """Reword an instruction, by one of the three templates of a form of 1..5."""
    templates = FORMS[form - 1]
    return templates[variant % len(templates)](orders_of(instruction))


def _said(orders: list[Order], verbs: Mapping[str, str]) -> str:
    return " and ".join(order.said(verbs) for order in orders)


def _outcomes(orders: list[Order]) -> str:
    return " and ".join(order.outcome for order in orders)


def _capitalised(text: str) -> str:
    return text[0].upper() + text[1:]


PLAIN: Mapping[str, str] = {}
OTHER = {
    "pick up": "grab", "put": "set", "place": "set", "push": "slide", "stack": "set", "open": "pull|open",
    "close": "shut", "turn on": "switch on", "turn off": "switch off",
}  # fmt: skip
THIRD = {
    "pick up": "lift", "put": "place", "place": "put", "push": "shove", "stack": "place", "open": "draw|open",
    "close": "push|shut", "turn on": "switch|on", "turn off": "switch|off",
}  # fmt: skip

FORMS = (
    (  # a paraphrase
        lambda orders: f"please {_said(orders, PLAIN)}",
        lambda orders: f"{_capitalised(_said(orders, OTHER))}.",
        lambda orders: f"Your task: {_said(orders, PLAIN)}.",
    ),
    (  # other words, other order
        lambda orders: f"Could you {_said(orders, THIRD)}?",
        lambda orders: f"I would like you to {_said(orders, OTHER)}.",
        lambda orders: f"{_capitalised(_said(orders, THIRD))}, please.",
    ),
    (  # clauses that distract
        lambda orders: (
            f"There is no hurry, and nothing else has to be moved. {_capitalised(_said(orders, PLAIN))}."
        ),
        lambda orders: f"Never mind what else lies around here: {_said(orders, OTHER)}.",
        lambda orders: f"After that we are finished for today, but first {_said(orders, PLAIN)}.",
    ),
    (  # what is to be, not what is to be done
        lambda orders: f"Make sure that {_outcomes(orders)}.",
        lambda orders: f"In the end it should be so that {_outcomes(orders)}.",
        lambda orders: f"You are done when {_outcomes(orders)}.",
    ),
    (  # both, and a clause that distracts
        lambda orders: (
            f"Everything else may stay as it is: what counts in the end is that {_outcomes(orders)}."
        ),
        lambda orders: f"Someone left it like this. I shall only be content once {_outcomes(orders)}.",
        lambda orders: (
            f"Whatever else you see, see to it that {_outcomes(orders)}, and leave the rest alone."
        ),
    ),
)
