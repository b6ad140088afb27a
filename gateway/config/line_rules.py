"""Checks the devices that share a line: station numbers, speed, format, unsolicited frames."""

from collections.abc import Sequence

from gateway.config.messages import Mistakes
from gateway.config.port_rules import (
    check_connection,
    check_datagrams,
    check_heartbeat,
    check_tls,
    direction,
)
from gateway.config.settings.model import LineSection
from gateway.config.settings.modem_settings import ModemSection
from gateway.engine.device.device_settings import DeviceSettings
from gateway.planning.wire_timing import NETWORK_BAUD, WireTiming, character_bits
from gateway.protocols.capabilities import EchoConflict
from gateway.protocols.listening import Listenable
from gateway.protocols.unsolicited import Unsolicited
from gateway.stations.registry import can_simulate
from gateway.tags.tag import NotReal
from gateway.transport.modem_events import ModemSettings
from gateway.transport.port import (
    ListenAddress,
    ModemAddress,
    SerialSettings,
    SimulatorAddress,
    TcpAddress,
    UdpAddress,
)

DIALS_IDLE, ANSWERS_IDLE = 5.0, 60.0  # seconds without an exchange until a call is ended
_TEXT = 20  # characters, more than the modem's own text NO CARRIER with its line ends
_LATE = 0.05  # seconds by which an adapter may delay a part of it


def check_line(line: LineSection, devices: Sequence[DeviceSettings], mistakes: Mistakes) -> None:
    """Notes every conflict between the line and its devices."""
    _check_unsolicited(devices, mistakes)
    _check_stations(devices, mistakes)
    if line.format is not None:
        _check_format(line.format, devices, mistakes.at("format"))
    if line.request_gap is not None and not line.serve:
        text = "request_gap is a setting of served lines: this line has no `serve: true`"
        mistakes.add(text, "request_gap")
    if line.listen_only:
        _check_listening(line, devices, mistakes)
    check_connection(line, devices, mistakes)
    check_tls(line, devices, mistakes)
    check_datagrams(line, devices, mistakes)
    check_heartbeat(line, devices, mistakes)
    for device in devices:
        driver, own = device.driver, mistakes.at("devices", device.name)
        if isinstance(line.port, SimulatorAddress) and not can_simulate(driver):
            mistakes.at("port").add(
                f"{device.name} cannot be simulated: there is no station for {driver.protocol}"
            )
        if line.echo and isinstance(driver, EchoConflict) and driver.echo_conflict is not None:
            setting, reason = driver.echo_conflict
            own.add(f"the line has `echo: true`, and {reason}", setting)
        if driver.traits.over_network:
            _check_network(line, devices, device, own)


def origin_of(line: LineSection, mistakes: Mistakes) -> NotReal | None:
    """Returns what stands behind the port instead of devices; None: real devices do."""
    simulator = isinstance(line.port, SimulatorAddress)
    if line.origin is not None and (simulator or line.serve):
        why = "port: simulator says it already" if simulator else "a served line reads no PLC"
        mistakes.add(f"{why}: remove origin", "origin")
    return "simulated" if simulator else line.origin


def _check_format(given: str, devices: Sequence[DeviceSettings], mistakes: Mistakes) -> None:
    """Refuses a format that the protocol of a device does not have, once for all devices."""
    binary = [device for device in devices if device.driver.traits.binary]
    others = [
        device
        for device in devices
        if device.driver.traits.one_format and device.driver.traits.format != given
    ]
    if binary and given[0] == "7":
        first = binary[0]
        mistakes.add(
            f"{given} has 7 data bits, but {_named(binary)} {first.driver.protocol}, which needs "
            f"8, such as 8{given[1:]}"
        )
    if not others:
        return
    traits, protocol = others[0].driver.traits, others[0].driver.protocol
    advice = f"If the ports are really set to {given}, write `format: {given}` there too"
    if binary:
        name, rtu = binary[0].name, binary[0].driver.protocol
        advice = f"{name} ({rtu}) needs 8 data bits: use two ports, or {protocol} devices in "
        advice += "their Modbus mode"
    mistakes.add(
        f"{given}, but {_named(others)} {protocol}, which is {traits.format} by its "
        f"manual or its own `format`. {advice}"
    )


def _named(devices: Sequence[DeviceSettings]) -> str:
    first, more = devices[0].name, len(devices) - 1
    return f"{first} and {more} more speak" if more else f"{first} speaks"


def _check_stations(devices: Sequence[DeviceSettings], mistakes: Mistakes) -> None:
    stations: dict[tuple[str, int], str] = {}
    for device in devices:
        if device.driver.traits.alone and len(devices) > 1:
            text = f"{device.driver.protocol} has no station numbers: give it a line of its own"
            mistakes.add(text, "devices", device.name, "protocol")
        if not device.driver.traits.numbered:
            continue
        protocol, number = device.driver.protocol, device.driver.station
        other = stations.setdefault((protocol, number), device.name)
        if other != device.name:
            mistakes.at("devices", device.name, "station").add(
                f"{other} on this line is station {number} already: both would answer at once"
            )


def _check_unsolicited(devices: Sequence[DeviceSettings], mistakes: Mistakes) -> None:
    """An unsolicited frame does not say which device sent it."""
    senders = [
        device.name
        for device in devices
        if isinstance(device.driver, Unsolicited) and device.driver.sends_unsolicited
    ]
    for name in senders[1:]:
        mistakes.at("devices", name, "listen").add(
            f"{senders[0]} on this line sends unsolicited frames already, and a frame does not "
            "say which device sent it: give this device a line of its own, or write both as one "
            "device"
        )


def _check_listening(
    line: LineSection, devices: Sequence[DeviceSettings], mistakes: Mistakes
) -> None:
    """Another master's requests and replies must be known, and found by one reader."""
    if line.serve:
        mistakes.at("listen_only").add(
            "a line with `serve: true` answers its master, so it cannot only listen: remove one"
        )
    if isinstance(line.port, SimulatorAddress):
        mistakes.add("listen_only: the simulator has no other master to listen to", "port")
    framings = dict[object, str]()
    for device in devices:
        driver, own = device.driver, mistakes.at("devices", device.name)
        if not isinstance(driver, Listenable) or driver.traits.over_network:
            own.at("protocol").add(
                f"the line has `listen_only: true`, and values of {driver.protocol} cannot be "
                "learned from another master: remove listen_only, or this device"
            )
            continue
        if device.identity:
            text = "a line with `listen_only: true` asks no device which one it is"
            own.add(text, "identity")
        other = framings.setdefault(driver.framing, device.name)
        first = next(iter(framings.values()))
        if other != first:
            own.at("protocol").add(
                f"the line has `listen_only: true`, and {first} has other frames: all devices of "
                "such a line have one protocol and one format"
            )


def _check_network(
    line: LineSection,
    devices: Sequence[DeviceSettings],
    device: DeviceSettings,
    mistakes: Mistakes,
) -> None:
    protocol = device.driver.protocol
    if not isinstance(line.port, TcpAddress | UdpAddress | ListenAddress | SimulatorAddress):
        mistakes.at("protocol").add(
            f"{protocol} needs a port tcp://host:port, udp://host:port or listen://host:port: it "
            "does not run on a serial line"
        )
    serial = [other for other in devices if not other.driver.traits.over_network]
    if serial:
        mistakes.at("protocol").add(
            f"{protocol} cannot share a line with {serial[0].name}, "
            f"which speaks {serial[0].driver.protocol}: give it a line of its own"
        )


def modem_of(
    line: LineSection, raw: object, wire: WireTiming, mistakes: Mistakes
) -> ModemSettings | None:
    """Returns the modem of a line; None: it has none. `raw`: the section, also with mistakes."""
    found, own = line.modem, mistakes.at("modem")
    if not isinstance(line.port, ModemAddress):
        if found is not None:
            own.add("the port has no modem: write it as modem:/dev/ttyS0")
        return None
    if line.listen_only:
        mistakes.add("a modem has a call only if it dials or answers", "listen_only")
    number = None if found is None else found.number
    named = isinstance(raw, dict) and "number" in raw
    if not (named or line.serve):
        own.add(
            'missing: write the number that it dials, such as modem: {number: "0,26204393"}; a '
            "line that answers calls has `serve: true`"
        )
    elif number is not None and line.serve:
        text = "a line with `serve: true` answers calls, it never dials: remove the number"
        own.add(text, "number")
    found = found or ModemSection()
    usual = ANSWERS_IDLE if line.serve else DIALS_IDLE
    settings = {
        **dict(found),
        "number": number or "",
        "idle": usual if found.idle is None else found.idle,
        "hold": _TEXT * wire.character + _LATE,
    }
    return ModemSettings(**settings)


def line_wire(
    line: LineSection, devices: Sequence[DeviceSettings], mistakes: Mistakes
) -> tuple[SerialSettings, WireTiming]:
    """Returns speed and format: those of the file, or the defaults of all protocols of the line."""
    rs485 = direction(line, mistakes)
    traits = {device.driver.protocol: device.driver.traits for device in devices}
    rates = {name: usual.baudrate for name, usual in traits.items()}
    formats = {name: usual.format for name, usual in traits.items()}
    if line.baudrate is None and set(rates.values()) == {None}:
        return SerialSettings(), WireTiming(NETWORK_BAUD, 10)
    for setting, given, usual in (
        ("baudrate", line.baudrate, rates),
        ("format", line.format, formats),
    ):
        if given is None and len(set(usual.values())) > 1:
            defaults = ", ".join(f"{name} {value}" for name, value in usual.items())
            mistakes.add(f"missing: the devices of this line differ in it ({defaults})", setting)
    baudrate = line.baudrate or next(filter(None, rates.values()), 9600)
    format_ = line.format or next(iter(formats.values()), "8N1")
    serial = SerialSettings(baudrate, format_, rs485)
    return serial, WireTiming(serial.baudrate, character_bits(serial.format))
