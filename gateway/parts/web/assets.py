"""The files of the status page. They need no build step, and nothing from other machines."""

from pathlib import Path

from aiohttp import web

from gateway.parts.web.routes import Route

_FOLDER = Path(__file__).parent / "assets"
_FILES = {
    "/": ("page.html", "text/html"),
    "/page.js": ("page.js", "text/javascript"),
    "/page.css": ("page.css", "text/css"),
}


def routes() -> list[Route]:
    return [
        file(path, (_FOLDER / name).read_bytes(), kind) for path, (name, kind) in _FILES.items()
    ]


def file(path: str, body: bytes, kind: str) -> Route:
    """Returns the route of a file."""

    async def asset(_: web.Request) -> web.Response:
        return web.Response(body=body, content_type=kind, charset="utf-8")

    return Route(path, asset, is_open=True)
