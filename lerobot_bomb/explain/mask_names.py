"""Names of the masks under which an episode is run, as keys of `explanation.json` and in sentences."""

NOTHING, WHOLE = "nothing", "the whole instruction"
OBJECT, HIDDEN_WORDS, ANOTHER = "object", "words", "another"  # kinds of the other masks


def mask_name(kind: str, name: str) -> str:
    """Return the key of a mask of a kind: "object: stone"."""
    return f"{kind}: {name}"


def is_hidden(mask: str) -> bool:
    """Return True unless the mask names another word in place of hiding something."""
    return not mask.startswith(ANOTHER)


def subject(mask: str) -> str:
    """Return "the stone", "the word for row", "another colour"."""
    kind, _, name = mask.partition(": ")
    told = {OBJECT: f"the {name}", HIDDEN_WORDS: word_name(name), ANOTHER: f"another {british(name)}"}
    return told.get(kind, mask)


def change(mask: str) -> str:
    """Return "the stone hidden", "another colour named"."""
    return f"{subject(mask)} {'hidden' if is_hidden(mask) else 'named'}"


def word_name(name: str) -> str:
    """Return "the word for row", "the words for row and column", 'the word "black"'."""
    if name.startswith('"'):
        return f"the word {name}"
    return f"the word{'s' if ' and ' in name else ''} for {british(name)}"


def british(name: str) -> str:
    """Spell a word of an instruction, such as "color", as sentences do."""
    return name.replace("color", "colour")
