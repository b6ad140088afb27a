"""The scalars of YAML 1.2, by which editors check.

`010` is ten, `yes` and `on` are texts, `1e-3` is a number.
"""

import re

_INT = re.compile(r"[-+]?[0-9]{1,300}\Z")  # a longer one is a float, and infinite
_BASED = re.compile(r"0o[0-7]+\Z|0x[0-9A-Fa-f]+\Z")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?\Z")
_WORDS: dict[str, object] = {
    "": None,
    "~": None,
    **dict.fromkeys(("null", "Null", "NULL"), None),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
    **dict.fromkeys((".inf", "+.inf", ".Inf", "+.Inf"), float("inf")),
    **dict.fromkeys(("-.inf", "-.Inf"), float("-inf")),
    **dict.fromkeys((".nan", ".NaN"), float("nan")),
}
_NUMERIC = frozenset("+-.0123456789")


def scalar(text: str) -> object:
    """Returns the value of a text without quotes."""
    if text in _WORDS:
        return _WORDS[text]
    if text[0] not in _NUMERIC:
        return text
    if _INT.match(text):
        return int(text)
    if _BASED.match(text):
        return int(text, 0)
    return float(text) if _FLOAT.match(text) else text
