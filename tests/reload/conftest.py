"""On the virtual clock no thread may work: hours could pass meanwhile."""

from collections.abc import Callable
from typing import TypeVar

import pytest

from gateway.service.reload import renewal

T = TypeVar("T")


@pytest.fixture(autouse=True)
def _without_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    async def at_once(function: Callable[..., T], *arguments: object) -> T:
        return function(*arguments)

    monkeypatch.setattr(renewal, "off_loop", at_once)
