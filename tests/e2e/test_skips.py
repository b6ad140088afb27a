"""A missing program skips its tests with a reason, or fails them with an option."""

import pytest

from tests.conftest import needs


def test_an_installed_program_is_found() -> None:
    assert needs("sh").endswith("/sh")


def test_a_missing_program_skips_the_test(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PLC_GATEWAY_NO_SKIPS", raising=False)
    with pytest.raises(pytest.skip.Exception, match="no-such-program is not installed"):
        needs("no-such-program")


def test_without_skips_a_missing_program_fails_the_test(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PLC_GATEWAY_NO_SKIPS", "1")
    with pytest.raises(pytest.fail.Exception, match="no-such-program is not installed"):
        needs("no-such-program")
