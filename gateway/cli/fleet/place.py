"""The gateways that a `fleet` command is about: their prefix, and how it reaches them."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from gateway.cli.client import Client, connected
from gateway.cli.terminal import ROUTER, err
from gateway.config import ZenohConfig, ZenohMode
from gateway.config.gateway_address import GatewayAddress
from gateway.contract.fleet_files import Wanted, wanted_in
from gateway.errors import ConfigError

Connect = Annotated[
    list[str] | None, typer.Option(metavar="ENDPOINT", help=f"A router or a gateway; {ROUTER}.")
]


@dataclass(frozen=True, slots=True)
class Place:
    """A prefix, and what the command line says before the name of a command below `fleet`."""

    prefix: str
    connect: list[str] | None
    zenoh_file: Path | None

    @contextmanager
    def connected(
        self, connect: list[str] | None = None, zenoh_file: Path | None = None
    ) -> Iterator[Client]:
        """Yields a client. The arguments are those after the name of the command."""
        file = zenoh_file or self.zenoh_file
        endpoints = tuple(connect or self.connect or (() if file else (ROUTER,)))
        own = ZenohConfig(
            prefix=self.prefix, mode=ZenohMode.CLIENT, connect=endpoints, config_file=file
        )
        address = GatewayAddress(name="fleet", standby=None, zenoh=own)
        with connected(address, err.print) as client:
            yield client

    def has(self, gateway: str) -> bool:
        return f"{gateway}/".startswith(f"{self.prefix}/")

    def wanted(self, folder: Path) -> tuple[dict[str, Wanted], list[str]]:
        """Returns as `wanted_in`, of the gateways under the prefix. Raises `ConfigError`."""
        if not folder.is_dir():
            raise ConfigError(f"{folder} is no folder")
        wanted, mistakes = wanted_in(folder)
        return {name: one for name, one in wanted.items() if self.has(name)}, mistakes
