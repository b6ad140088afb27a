"""Which gateway serves which device: by the liveliness tokens."""


class Presence:
    """The gateways that are there, and the devices that they report as answering."""

    def __init__(self) -> None:
        self.gateways: set[str] = set()
        self.trusted: set[str] = set()  # devices that answer, described since they do
        self._alive: dict[str, set[str]] = {}  # device: the gateways that report it as answering
        self._served_by: dict[str, str] = {}  # device: the last of them
        self._asked: set[str] = set()  # devices whose descriptions are being read

    @property
    def alive(self) -> set[str]:
        """The devices that answer."""
        return {device for device, gateways in self._alive.items() if gateways}

    def arrived(self, gateway: str, device: str) -> None:
        self._alive.setdefault(device, set()).add(gateway)
        self._served_by[device] = gateway
        self._asked.discard(device)

    def is_lost(self, gateway: str, device: str) -> bool:
        """Forgets that the gateway reports the device. Returns True if no other one does."""
        alive = self._alive.get(device, set())
        alive.discard(gateway)
        if not alive:
            self._asked.discard(device)
            self.trusted.discard(device)
        return not alive

    def may_be_of(self, gateway: str, device: str) -> bool:
        return self._served_by.get(device, gateway) == gateway

    def asked(self) -> None:
        """All descriptions are asked for now."""
        self._asked = self.alive

    def described(self, devices: set[str]) -> None:
        """These devices were described since `asked`."""
        self.trusted |= self._asked & devices
