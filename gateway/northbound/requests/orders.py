"""Orders to a part, such as the acknowledgement of an alarm, by the rules of writes."""

import time

from gateway.contract import payload
from gateway.contract.interfaces import Parts
from gateway.contract.keys import Keys
from gateway.contract.payload import Failure, WriteOutcome
from gateway.errors import BadValue, GatewayError
from gateway.northbound.requests.acceptance import Acceptance, Sender
from gateway.northbound.requests.audit import Audit


class Orders:
    """Passes orders on. Belongs to the event loop."""

    def __init__(self, keys: Keys, parts: Parts, audit: Audit, acceptance: Acceptance) -> None:
        """`audit` gets each refusal."""
        self._keys = keys
        self._parts = parts
        self._audit = audit
        self._acceptance = acceptance

    async def execute(self, part: str, key: str, data: bytes, sender: Sender) -> bytes | Failure:
        """Returns the new document. `key`, `data`: as received."""
        try:
            by = self._acceptance.accept(key, data, sender).by
            await self._acceptance.kept()
            if "*" in key:
                raise BadValue(f"{payload.short(key)} has a wildcard: an order names one")
            path = key.removeprefix(self._keys.status(f"{part}/"))
            return await self._parts.keyed(part).order(path, data, by)
        except GatewayError as error:
            failure = payload.audited(error)
            self._audit(WriteOutcome(key, None, failure, time.time_ns(), 0.0, command=True))
            return failure
