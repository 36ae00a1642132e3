"""Check for a token that no HTTP header can hold, before the HTTP library quotes it in an error."""

import os

VARIABLES = ("HF_TOKEN", "HUGGING_FACE_HUB_TOKEN")
LOG_IN = "run `hf auth login`, or set HF_TOKEN"


class TokenError(ValueError):
    """Error that describes what is wrong with a token, without quoting it."""


def check_token_characters(token: str) -> None:
    """Raise a TokenError unless all characters of the token can be sent.

    In a variable, characters that huggingface_hub would strip are refused too: the rest is another token.
    """
    given = {name: os.environ.get(name, "").strip() for name in VARIABLES}
    for source, text in {"your token": token, **given}.items():
        bad = [index for index, each in enumerate(text) if not ("!" <= each <= "~")]
        if bad:
            kind = "a space" if text[bad[0]] == " " else "a control character or one that is not ASCII"
            raise TokenError(
                f"{source} contains {kind}, after {bad[0]} of its {len(text)} characters, so it is no token "
                f"of the Hub: {LOG_IN} to the token alone"
            )
