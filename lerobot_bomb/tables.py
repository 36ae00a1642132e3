"""Tables of text."""

from collections.abc import Sequence


def printable(text: str) -> str:
    """Escape what a terminal would obey or hide: colours, ends of lines."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def print_lines(*lines: str) -> None:
    """Print each text on one line, whatever is in it."""
    print(*map(printable, lines), sep="\n")


def print_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print rows of text, the first column to the left, the others to the right."""
    header, rows = [*map(printable, header)], [[*map(printable, row)] for row in rows]
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
    for name, *cells in [header, *rows]:
        padded = [cell.rjust(width) for cell, width in zip(cells, widths[1:], strict=True)]
        print("  ".join([name.ljust(widths[0]), *padded]).rstrip())
