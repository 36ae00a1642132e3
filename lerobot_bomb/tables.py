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
