"""Commands and code as a card shows them."""

import shlex

WIDTH = 100


def command(name: str, *flags: str) -> str:
    """A command line, broken where it is long."""
    lines, line = [], name
    for flag in map(shlex.quote, flags):
        if len(line) + len(flag) > WIDTH:
            lines.append(line)
            line = f"    {flag}"
        else:
            line = f"{line} {flag}"
    return " \\\n".join([*lines, line])


def fenced(text: str, language: str = "") -> str:
    """A block of code."""
    return f"```{language}\n{text}\n```"
