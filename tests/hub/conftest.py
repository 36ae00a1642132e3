"""The Hub on this machine, and commands that see no other."""

from collections.abc import Iterator

import pytest

from hub.server import LoopbackHub


@pytest.fixture
def hub() -> Iterator[LoopbackHub]:
    with LoopbackHub().served() as served:
        yield served
