"""The files of the status page. They need no build step, and nothing from other machines."""

from pathlib import Path

from aiohttp import web

_FOLDER = Path(__file__).parent / "assets"
_FILES = {
    "/": ("page.html", "text/html"),
    "/page.js": ("page.js", "text/javascript"),
    "/page.css": ("page.css", "text/css"),
    "/openapi.json": ("openapi.json", "application/json"),
}


def routes() -> list[web.RouteDef]:
    return [_route(path, *file) for path, file in _FILES.items()]


def _route(path: str, name: str, kind: str) -> web.RouteDef:
    body = (_FOLDER / name).read_bytes()

    async def asset(_: web.Request) -> web.Response:
        return web.Response(body=body, content_type=kind, charset="utf-8")

    return web.get(path, asset)
