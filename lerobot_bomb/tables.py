"""Tables of text."""

from collections.abc import Collection, Iterable, Sequence

MAX_NAME = 36  # characters of a name in a table or chart


def printable(text: str) -> str:
    """Escape what a terminal would obey or hide: colours, ends of lines."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def shorten(name: str, most: int = MAX_NAME) -> str:
    """Return a name of at most so many characters, without its middle if it is longer."""
    if len(name) <= most:
        return name
    last = (most - 1) // 2
    return f"{name[: most - 1 - last]}…{name[-last:]}"


def shorten_all(names: Iterable[str], most: int = MAX_NAME) -> dict[str, str]:
    """Return {name: the name of at most so many characters}; names that differ still do."""
    return _shorten_from(0, dict.fromkeys(names), most)


def _shorten_from(start: int, names: Iterable[str], most: int) -> dict[str, str]:
    """Shorten names that are equal before `start`, of which only the first part is kept."""
    alike: dict[str, list[str]] = {}
    for name in names:
        first = f"{name[: most // 3]}…" if start else ""
        alike.setdefault(first + shorten(name[start:], most - len(first)), []).append(name)
    short = {}
    for text, several in alike.items():
        is_alone = len(several) == 1
        short |= {several[0]: text} if is_alone else _shorten_from(num_shared(several), several, most)
    return short


def num_shared(several: Sequence[Sequence[str]]) -> int:
    """Return how many parts, or characters of texts, all begin with."""
    number = 0
    for parts in zip(*several, strict=False):
        if len(set(parts)) > 1:
            break
        number += 1
    return number


def in_a_row(names: Sequence[str], last: str = "and") -> str:
    """Return 'a, b and c'; ``last``: the word before the last name."""
    return f" {last} ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def first_of(names: Sequence[str], most: int) -> list[str]:
    """Return the first names, and how many more there are."""
    more = len(names) - most
    return [*names[:most]] + ([f"{more} more"] if more > 0 else [])


def print_lines(*lines: str) -> None:
    """Print each text on one line, whatever is in it."""
    print(*map(printable, lines), sep="\n")


def print_table(header: Sequence[str], rows: Sequence[Sequence[str]], left: Collection[str] = ()) -> None:
    """Print rows of text, the first column and those named in `left` to the left, the others to the right."""
    aligned = [str.rjust if place and name not in left else str.ljust for place, name in enumerate(header)]
    header, rows = [*map(printable, header)], [[*map(printable, row)] for row in rows]
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    for row in [header, *rows]:
        print("  ".join(map(lambda align, *cell: align(*cell), aligned, row, widths)).rstrip())


def markdown_table(header: str, rows: Iterable[Iterable[str]]) -> list[str]:
    """Lay out rows of cells under a header, `a | b`, as lines of Markdown, the last of them empty."""
    rule = "---|" * len(header.split("|"))
    cells = (" | ".join(cell.replace("|", "\\|") for cell in row) for row in rows)
    return [f"| {header} |", f"|{rule}", *(f"| {row} |" for row in cells), ""]
