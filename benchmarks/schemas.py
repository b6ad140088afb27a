"""Writes the schemas of all documents on Zenoh, made from their types: `make schema`."""

import json
import re
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter
from pydantic.json_schema import GenerateJsonSchema

from gateway.contract.documents.catalogue import FILE, PLACE, RAW, REASONS, SUBSCRIBE
from gateway.contract.documents.catalogue import KINDS as CORE
from gateway.contract.keys import CONTRACT
from gateway.parts import registry

ROOT = Path(__file__).parents[1]
KINDS = (*CORE, *(one for _, part in registry.kinds() for one in part.documents))
ASYNCAPI = ROOT / "docs" / "asyncapi.json"


class _Plain(GenerateJsonSchema):
    """Without a title for each field."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False


def schema() -> dict[str, Any]:
    """Returns the JSON Schema of every document, made from the types."""
    shapes = [of for kind in KINDS for of in (kind.shape, kind.takes) if of is not None]
    found, shared = TypeAdapter.json_schemas(
        [(repr(of), "serialization", TypeAdapter(of)) for of in shapes], schema_generator=_Plain
    )
    documents = {}
    for kind in KINDS:
        documents[kind.name] = {
            "key": f"{{prefix}}/{kind.key}",
            "verbs": list(kind.verbs),
            "schema": found[repr(kind.shape), "serialization"],
        }
        if kind.takes is not None:
            documents[kind.name]["takes"] = found[repr(kind.takes), "serialization"]
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "What a PLC gateway puts on Zenoh",
        "contract": CONTRACT,
        "reasons": {
            reason.value: {"opcua": code, "ne107": signal}
            for reason, (code, signal) in REASONS.items()
        },
        "documents": documents,
        **shared,
    }


def asyncapi(found: dict[str, Any]) -> dict[str, Any]:
    """Returns the same as an AsyncAPI document. `found`: what `schema` returns."""
    channels: dict[str, Any] = {}
    operations: dict[str, Any] = {}
    inside = json.dumps(found).replace("#/$defs/", "#/components/schemas/")
    found = json.loads(inside)
    for name, document in found["documents"].items():
        if name in (RAW, PLACE):
            continue  # no payload
        channel = name.replace(": ", "_").replace(" ", "_")
        places = re.findall(r"{(\w+)}", document["key"])
        messages = {"reply": {"contentType": "application/json", "payload": document["schema"]}}
        if "takes" in document:
            messages["request"] = {"contentType": "application/json", "payload": document["takes"]}
        channels[channel] = {
            "address": document["key"],
            "parameters": {place: {} for place in places},
            "messages": messages,
        }
        at = {"$ref": f"#/channels/{channel}"}
        replies = [{"$ref": f"#/channels/{channel}/messages/reply"}]
        for verb in document["verbs"]:
            operation = {"channel": at, "title": verb, "summary": f"A client can {verb}."}
            if verb == SUBSCRIBE:
                operation |= {"action": "send", "messages": replies}
            else:
                asked = [{"$ref": f"#/channels/{channel}/messages/{one}"} for one in messages]
                reply = {"channel": at, "messages": replies}
                operation |= {"action": "receive", "messages": asked[1:], "reply": reply}
            operations[f"{channel}.{verb.partition(' with ')[0]}"] = operation
    return {
        "asyncapi": "3.0.0",
        "info": {"title": found["title"], "version": f"{CONTRACT}.0.0"},
        "defaultContentType": "application/json",
        "channels": channels,
        "operations": operations,
        "components": {"schemas": found["$defs"]},
    }


def text(document: dict[str, Any]) -> str:
    """Returns a document as the repository keeps it."""
    return json.dumps(document, indent=1, ensure_ascii=False) + "\n"


def main() -> None:
    found = schema()
    FILE.write_text(text(found), "utf-8")
    ASYNCAPI.write_text(text(asyncapi(found)), "utf-8")


if __name__ == "__main__":
    main()
