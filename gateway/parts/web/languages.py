"""The catalogue of the page, in the language that the client chose, the file names, or the browser
accepts."""

import json

from aiohttp import web

from gateway.contract.languages import LANGUAGES, Language, catalogue, matching
from gateway.parts.web.listener import file_route
from gateway.parts.web.routes import Route

COOKIE = "language"


def catalogue_route(texts: str, configured: Language | None = None) -> Route:
    """Returns the route of the module `catalogue.js`. `texts`: the part of the catalogue, `page`
    or `bench`."""
    names = {language: catalogue(language)["name"] for language in LANGUAGES}
    routes = {
        language: file_route("", _module(language, texts, names), "text/javascript")
        for language in LANGUAGES
    }

    async def chosen(request: web.Request) -> web.StreamResponse:
        language = request.cookies.get(COOKIE) or configured
        if language not in routes:
            language = configured or matching(request.headers.get("Accept-Language", ""))
        found = await routes[language].handler(request)
        found.headers["Vary"] = "Accept-Encoding, Accept-Language, Cookie"
        found.headers["Content-Language"] = language
        return found

    return Route("/catalogue.js", chosen, is_open=True)


def _module(language: Language, texts: str, names: dict[Language, str]) -> bytes:
    found = catalogue(language)
    document = {
        "code": language,
        "languages": names,
        "page": found[texts],
        "sentences": found["sentences"],
    }
    text = json.dumps(document, ensure_ascii=False, separators=(",", ":"))
    return f"export default {text};".encode()
