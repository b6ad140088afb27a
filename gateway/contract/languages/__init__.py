"""Sentences of the gateway in other languages. Documents stay English, with codes.

A catalogue is one JSON file: `page` and `bench` have the texts of the pages, `sentences` those of
the gateway, each by its English words. `{name}` is a place. In a sentence the name says what may
be there: `why…` another sentence, which is translated too, `names…` a list, `text…` anything, `n`
a number, all others one word. `language.js` of the page does the same.
"""

import json
import re
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, Literal, get_args

Language = Literal["en", "de", "ko", "zh-CN", "zh-TW"]
LANGUAGES: tuple[Language, ...] = get_args(Language)
PLACE = re.compile(r"\{(\w+)\}")
_FOLDER = Path(__file__).parent
_KINDS = (("(why|text).*", ".+"), ("names.*", "[^:;]+"), ("n", r"[-+\d.,]+"), (".*", r"\S+"))
_TRANSLATED = ("why", "names")
_CHINESE = {"tw": "zh-TW", "hk": "zh-TW", "mo": "zh-TW", "hant": "zh-TW"}
Catalogue = Mapping[str, Any]


@cache
def catalogue(language: Language) -> Catalogue:
    """Returns the catalogue of a language; that of English is empty. Reads a file once."""
    if language == "en":
        return {"name": "English", "page": {}, "bench": {}, "sentences": {}}
    found: Catalogue = json.loads((_FOLDER / f"{language}.json").read_text(encoding="utf-8"))
    return found


def matching(accepted: str) -> Language:
    """Returns the language for an `Accept-Language` header: English if none is known."""
    ranked = list[tuple[float, Language]]()
    for one in accepted.lower()[:1000].split(","):
        tag, _, rest = one.strip().partition(";")
        quality = re.fullmatch(r"\s*q=([01](?:\.\d{0,3})?)\s*", rest)
        first, *others = tag.split("-")
        found = first
        if first == "zh":
            found = next((_CHINESE[part] for part in others if part in _CHINESE), "zh-CN")
        weight = float(quality[1]) if quality else 1.0
        ranked += [(weight, known) for known in LANGUAGES if known == found and weight]
    return max(ranked, key=lambda one: one[0], default=(0.0, LANGUAGES[0]))[1]


@cache
def translator(language: Language) -> Callable[[str], str]:
    """Returns what translates a sentence of the gateway; an unknown one stays as it is."""
    sentences = catalogue(language)["sentences"]
    patterns = [
        (re.compile(_pattern(words), re.DOTALL), sentences[words])
        for words in sorted(sentences, key=lambda words: -len(PLACE.sub("", words)))
    ]

    def translated(text: str) -> str:
        for pattern, words in patterns:
            if found := pattern.fullmatch(text):
                return str(words).format_map(
                    {
                        name: translated(part) if name.startswith(_TRANSLATED) else part
                        for name, part in found.groupdict().items()
                    }
                )
        return text

    return translated


def _pattern(words: str) -> str:
    parts = PLACE.split(words)  # text and names in turn
    return "".join(f"({_place(one)})" if at % 2 else re.escape(one) for at, one in enumerate(parts))


def _place(name: str) -> str:
    kind = next(pattern for names, pattern in _KINDS if re.fullmatch(names, name))
    return f"?P<{name}>{kind}"
