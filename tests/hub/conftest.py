"""The Hub on this machine, and commands that see no other."""

from collections.abc import Iterator

import pytest

from hub.server import TOKEN, LoopbackHub


@pytest.fixture
def hub() -> Iterator[LoopbackHub]:
    with LoopbackHub().served() as served:
        yield served


@pytest.fixture
def online(hub: LoopbackHub, monkeypatch: pytest.MonkeyPatch) -> LoopbackHub:
    """This process, too, sees the Hub on this machine alone."""
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "ENDPOINT", hub.endpoint)
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
    monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)
    monkeypatch.setattr("huggingface_hub.utils._http.time.sleep", lambda _: None)  # between retries
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    return hub
