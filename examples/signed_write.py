"""Writes a tag of a gateway that has `writers`, with a signature in place of the secret.

`PLC_GATEWAY_WRITER=alice:… python examples/signed_write.py plant/mixer/recipe 7`. The variable
holds the line of the writers file. Copy `sign` into your own program.
"""

import argparse
import hashlib
import hmac
import json
import os
import secrets
import sys
from datetime import UTC, datetime

import zenoh


def sign(writer: str, key: str, payload: str) -> str:
    """Returns the attachment of a write. `writer`: the line `name:secret` of the writers file.

    A signature counts once and for five seconds: sign again before you write again.
    """
    name, _, secret = writer.partition(":")
    time, nonce = datetime.now(UTC).isoformat(), secrets.token_hex(16)
    text = f"{name}\n{time}\n{nonce}\n{key}\n{payload}"
    signature = hmac.new(secret.encode(), text.encode(), hashlib.sha256).hexdigest()
    return json.dumps({"by": name, "time": time, "nonce": nonce, "signature": signature})


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tag", help="the key of the value: plant/mixer/recipe")
    parser.add_argument("value", help='JSON: true, 12.5, "AB"')
    parser.add_argument("--connect", default="tcp/127.0.0.1:7447")
    given = parser.parse_args()
    config = zenoh.Config()
    config.insert_json5("mode", json.dumps("client"))
    config.insert_json5("connect/endpoints", json.dumps([given.connect]))
    key = f"{given.tag}/@set"
    attachment = sign(os.environ["PLC_GATEWAY_WRITER"], key, given.value)
    with zenoh.open(config) as session:
        for reply in session.get(key, payload=given.value, attachment=attachment, timeout=10.0):
            if reply.ok is not None:
                print(reply.ok.payload.to_string())
                return 0
            if reply.err is not None:
                print(reply.err.payload.to_string())
    return 1  # `unclear` and no reply: it is unknown whether it was done


if __name__ == "__main__":
    sys.exit(main())
