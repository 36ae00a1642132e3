"""Text of others in a card: it ends no block, begins no link, and is no HTML."""

import pytest

from lerobot_bomb.hub.markdown import code, fenced, plain


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("suite=place, seeds 0..9", "suite=place, seeds 0..9"),
        ("target=[2, 2]", "target=[2, 2]"),
        ("<img src=x>", "&lt;img src=x&gt;"),
        ("[here](http://x)", "[here]\\(http://x)"),
        ("a | b * `c`", "a \\| b \\* \\`c\\`"),
        ("one\ntwo\x1b[31m", "one\\\\ntwo\\\\x1b[31m"),
    ],
)
def test_plain_text_means_nothing(text: str, shown: str) -> None:
    assert plain(text) == shown


def test_nothing_ends_a_block_of_code() -> None:
    assert fenced("a\nb", "bash") == "```bash\na\nb\n```"
    assert fenced("a\n```\n<b>") == "````\na\n```\n<b>\n````"
    assert fenced("a\x1b[31m") == "```\na\\x1b[31m\n```"


def test_nothing_ends_code_in_a_line() -> None:
    assert code("observation.state") == "`observation.state`"
    assert code("a`|<b>") == "`` a`\\|<b> ``"
