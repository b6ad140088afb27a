"""Requests to an InfluxDB server, with the token of `INFLUX_TOKEN`."""

import os
import urllib.request

MOST_BYTES = 2**24  # of an answer


def request(url: str, body: bytes | None, within: float) -> bytes:
    """Returns the answer; blocks. With a body it is a POST.

    Raises `urllib.error.HTTPError` for an error of the server, `OSError` and
    `http.client.HTTPException` if there is no whole answer within so many seconds.
    """
    headers = {"Content-Type": "text/plain; charset=utf-8"}
    if token := os.environ.get("INFLUX_TOKEN"):
        headers["Authorization"] = f"Token {token}"
    made = urllib.request.Request(url, body, headers)  # noqa: S310  (the command line names it)
    with urllib.request.urlopen(made, timeout=within) as answer:  # noqa: S310  (as above)
        found: bytes = answer.read(MOST_BYTES)
    return found
