"""Each code of a fault, a warning and a diagnosis is on the page of codes, and names a document."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import gateway
from gateway.contract.faults import coded_faults, coded_warnings
from gateway.errors import Evidence
from tests.web.test_languages import wrong

GATEWAY = Path(gateway.__file__).parent
CHECK = GATEWAY / "cli" / "config" / "check.py"
PAGE = GATEWAY.parent / "docs" / "codes.md"


def codes() -> Iterator[str]:
    """Yields the codes of all calls of `Fault` and `Diagnosis`, and of the warnings of `check`."""
    yield from (one.value for one in Evidence)
    for file in GATEWAY.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            match node:
                case ast.Call(
                    func=ast.Name("Fault" | "Diagnosis"), args=[ast.Constant(str(code)), *_]
                ) if code:
                    yield code
                case ast.Yield(ast.Tuple([ast.Constant(str(code)), _])) if file == CHECK:
                    yield code


def test_the_page_of_codes_has_each_code_and_no_other() -> None:
    rows = [one for one in PAGE.read_text().splitlines() if one.startswith("| `")]
    listed = {code for row in rows for code in re.findall("`([a-z-]+)`", row.split("|")[1])}
    assert listed == {*codes()}


def test_what_is_coded_names_the_document_that_has_its_figures() -> None:
    documents = {
        "status": {"refused_devices": {}, "answered_elsewhere": "plant/mixer/speed"},
        **wrong(),
    }
    documents["lines/hall"] = {**documents["lines/hall"], "expected": {"load": 1.4}}
    documents["devices/hall-2"] = {**documents["devices/hall-2"], "diagnosis_code": "noise"}
    documents["lines/hall"]["devices"] = {"mixer": "up", "oven": "silent", "hall-2": "up"}
    found = [*coded_faults(documents), *coded_warnings(documents)]
    assert {one.about for one in found} <= {*documents}
    assert {
        ("line-down", "lines/pumps"),
        ("no-router", "zenoh"),
        ("overloaded", "lines/hall"),
        ("noise", "devices/hall-2"),
        ("answered-elsewhere", "status"),
    } <= {(one.code, one.about) for one in found}
