"""Commands and code as a card shows them."""

import re
import shlex
from html import escape

from lerobot_bomb.tables import printable

WIDTH = 100


def command(name: str, *flags: str) -> str:
    """Return a command line, broken if it is long."""
    lines, line = [], name
    for flag in map(shlex.quote, flags):
        if len(line) + len(flag) > WIDTH:
            lines.append(line)
            line = f"    {flag}"
        else:
            line = f"{line} {flag}"
    return " \\\n".join([*lines, line])


def fenced(text: str, language: str = "") -> str:
    """Return a block of code, with a fence longer than any run of backticks in it."""
    fence = "`" * max(3, _longest_run(text) + 1)
    shown = "\n".join(map(printable, text.split("\n")))
    return f"{fence}{language}\n{shown}\n{fence}"


def code(text: str) -> str:
    """Return inline code, also for a table, with more backticks than any run of them in it."""
    ticks = "`" * (_longest_run(text) + 1)
    pad = " " * ("`" in text)
    return f"{ticks}{pad}{printable(text).replace('|', chr(92) + '|')}{pad}{ticks}"


def plain(text: str) -> str:
    """Escape text so that it means nothing in Markdown or HTML, also in a table."""
    return re.sub(r"[\\`*|]|(?<=\])\(", r"\\\g<0>", escape(printable(text), quote=False))


def _longest_run(text: str) -> int:
    """Return the length of the longest run of backticks."""
    return max(map(len, re.findall("`+", text)), default=0)
