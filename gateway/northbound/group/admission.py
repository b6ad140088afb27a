"""Decides when this gateway may serve its plant, and which of its devices."""

import asyncio
from collections.abc import Iterable, Mapping

import zenoh

from gateway.contract.access import secrets
from gateway.contract.keys import Keys
from gateway.line.send_permit import SendPermit
from gateway.northbound.group.claiming import NETWORK_WITHIN, Claiming
from gateway.northbound.group.plant_secret import PlantSecret
from gateway.northbound.group.standby import GroupSettings, Standby
from gateway.northbound.session.session import SecondSession
from gateway.tags.tag import NotReal


class Admission:
    """The election of a standby group first, then the claims of all gateways under the prefix.

    Sets `active` when the gateway may open its lines, `replaced` when it must close them and start
    over: as standby, or with other devices `withheld`.
    """

    def __init__(
        self,
        settings: GroupSettings,
        keys: Keys,
        config: zenoh.Config,
        devices: Iterable[str],
        duty: SendPermit,
    ) -> None:
        """`config`: of the gateway's own session. Raises `ConfigError` for a bad secret."""
        self.active = asyncio.Event()
        text = secrets.plant_secret(settings.secret_file)
        secret = None if text is None else PlantSecret(text)
        self.standby = Standby(settings, secret, keys, duty)
        self.replaced = self.standby.replaced
        self.claiming = Claiming(keys, settings.group, secret, devices, self.active, self.replaced)
        self._second = SecondSession(config)

    def documents(self, origins: Mapping[str, NotReal]) -> Mapping[str, Mapping[str, object]]:
        """`origins`: of devices that are not real."""
        return {**self.standby.documents(), **self.claiming.documents(origins)}

    def sessions(self) -> list[zenoh.Session]:
        """Sessions of tokens; the gateway's own may be one of them."""
        return self._second.opened

    async def run_alone(self) -> None:
        """Lets the gateway serve while a client waits for its router, unless it has a group."""
        await asyncio.sleep(NETWORK_WITHIN)
        if not self.standby.enabled:
            self.active.set()

    async def run(self, session: zenoh.Session) -> None:
        """Runs until cancelled. `session` is the gateway's own. Raises `GatewayError`, `ZError`."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._second.run(session))
            tasks.create_task(self.standby.run(session, self._second))
            await self.standby.active.wait()
            await self.claiming.run(session, self._second)
