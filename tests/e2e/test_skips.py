"""The one rule for what a machine lacks: skipped with a reason, or failed if that is asked for."""

import pytest

from tests.conftest import needs


def test_a_program_that_is_there() -> None:
    assert needs("sh").endswith("/sh")


def test_a_program_that_is_missing_skips_the_test(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PLC_GATEWAY_NO_SKIPS", raising=False)
    with pytest.raises(pytest.skip.Exception, match="no-such-program is not installed"):
        needs("no-such-program")


def test_where_nothing_may_be_skipped_the_test_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PLC_GATEWAY_NO_SKIPS", "1")
    with pytest.raises(pytest.fail.Exception, match="no-such-program is not installed"):
        needs("no-such-program")
