"""A client that asks a lot and receives nothing.

    python deaf_client.py tcp/127.0.0.1:7447 60 2000

Its first reply holds up the thread that receives, as a slow callback does.
"""

import json
import sys
import threading
import time

import zenoh


def main(endpoint: str, wide: int, narrow: int) -> None:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    stuck, never = threading.Event(), threading.Event()

    def receive(_: zenoh.Reply) -> None:
        stuck.set()
        never.wait()

    handler = zenoh.handlers.Callback(receive, indirect=False)
    session = zenoh.open(config)
    for _ in range(wide):
        session.get("plant/**", handler, consolidation=zenoh.ConsolidationMode.NONE)
    stuck.wait()
    time.sleep(1.0)  # the buffers of the system fill meanwhile
    for _ in range(narrow):
        session.get("plant/plc/t0", handler)
    print("asked", flush=True)
    never.wait()


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
