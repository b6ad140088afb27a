"""What the tests of the web door share."""

from pathlib import Path

import pytest

from tests.web.serving import TOKEN


@pytest.fixture
def tokens(tmp_path: Path) -> Path:
    path = tmp_path / "tokens.txt"
    path.write_text(f"alice:{TOKEN}\n")
    path.chmod(0o600)
    return path
