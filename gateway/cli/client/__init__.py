"""The client of a running gateway, over Zenoh."""

from gateway.cli.client.arguments import (
    matches,
    parse_value,
    suggestion,
    tags_by_key,
    wanted_keys,
)
from gateway.cli.client.client import Client, NoGateway
from gateway.cli.client.connection import connected, reached
from gateway.cli.client.rows import TagRow
