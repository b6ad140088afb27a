"""The description of the JSON API as an OpenAPI document, made from the routes."""

import re
from collections.abc import Iterable
from typing import Any

from gateway.parts.web.routes import Route
from gateway.parts.web.schemas import SCHEMAS, TEXT, Schema, ref

_ERRORS = {
    401: "A token is needed",
    403: "Another site, or no token",
    421: "The Host is no name of this machine",
    503: "Too many requests, or not available now",
}
_ABOUT = (
    "Values of PLCs with quality and time, the state of lines and devices, history, writes. "
    "Reading needs a token only if the gateway listens on another address than loopback; writing "
    "always does."
)
_PLACE = re.compile(r"\{(\w+)\}")


def document(routes: Iterable[Route]) -> dict[str, Any]:
    """Returns the document of the routes that are described."""
    paths: dict[str, Any] = {}
    for route in routes:
        if route.about:
            paths.setdefault(route.path, {})[route.method] = _operation(route)
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "PLC gateway",
            "version": "1",
            "license": {"name": "Apache-2.0", "identifier": "Apache-2.0"},
            "description": _ABOUT,
        },
        "servers": [{"url": "."}],  # relative: a proxy may have another path
        "paths": paths,
        "components": {
            "schemas": SCHEMAS,
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
        },
    }


def _operation(route: Route) -> dict[str, Any]:
    places = [_parameter(name, "path", TEXT, required=True) for name in _PLACE.findall(route.path)]
    asked = [
        _parameter(one.name, "query", one.schema, required=one.required, about=one.about)
        for one in route.parameters
    ]
    name = route.path.rpartition("/")[2].strip("{}")
    found: dict[str, Any] = {"operationId": name, "summary": route.about}
    if places or asked:
        found["parameters"] = places + asked
    if route.body is not None:
        content = {"application/json": {"schema": route.body}}
        found["requestBody"] = {"required": True, "content": content}
    found["responses"] = _responses(route)
    if not route.is_open:
        found["security"] = [{"token": []}] if route.method == "post" else [{}, {"token": []}]
    return found


def _parameter(
    name: str, place: str, schema: Schema, *, required: bool, about: str = ""
) -> dict[str, Any]:
    found = {"name": name, "in": place, "required": required, "schema": schema}
    return {**found, "description": about} if about else found


def _responses(route: Route) -> dict[str, Any]:
    errors = {**({} if route.is_open else _ERRORS), **route.errors}
    shapes = {**dict.fromkeys(errors, "Error"), **dict.fromkeys(route.failures, "Failure")}
    texts = {**errors, **route.failures}
    kind = route.kind if route.is_open else "application/json"
    return {
        "200": _response(route.done, route.kind, route.reply),
        **{
            str(status): _response(
                texts[status], kind, TEXT if route.is_open else ref(shapes[status])
            )
            for status in sorted(shapes)
        },
    }


def _response(about: str, kind: str, schema: Schema) -> dict[str, Any]:
    return {"description": about, "content": {kind: {"schema": schema}}}
