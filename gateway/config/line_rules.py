"""What must agree among the devices that share a wire: station numbers, speed, format."""

from collections.abc import Sequence

from gateway.config.customs import custom
from gateway.config.messages import Mistakes, Path
from gateway.config.model import LineSection
from gateway.engine.device import DeviceSettings
from gateway.planning.wire_timing import NETWORK_BAUD, WireTiming, character_bits
from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.frames import FrameDriver
from gateway.protocols.unsolicited import Unsolicited
from gateway.transport.port import SerialSettings, SimulatorAddress, TcpAddress


def check_line(
    line: LineSection, devices: Sequence[DeviceSettings], path: Path, mistakes: Mistakes
) -> None:
    """Note what cannot live together on this line."""
    stations: dict[int, str] = {}
    _check_listening(devices, path, mistakes)
    for device in devices:
        place = (*path, "devices", device.name)
        number = device.driver.station
        if isinstance(device.driver, FrameDriver):  # it has no number
            if isinstance(line.port, SimulatorAddress):
                mistakes.add(
                    (*path, "port"), f"{device.name} cannot be simulated: it has no protocol"
                )
            continue
        other = stations.setdefault(number, device.name)
        if other != device.name:
            mistakes.add(
                (*place, "station"),
                f"{other} on this line is station {number} already: both would answer at once",
            )
        if line.echo and isinstance(device.driver, ComputerLink) and device.driver.send_area_c:
            mistakes.add(
                (*place, "send_area_c"),
                "the line has `echo: true`, and the echo of this acknowledgement looks exactly "
                "like the PLC's to a write: leave it out, no PLC is known to need it",
            )
        if custom(device.driver).baudrate is None:
            _check_network(line, devices, device, place, mistakes)
        elif custom(device.driver).eight_bits and line.format and line.format[0] == "7":
            mistakes.add(
                (*path, "format"),
                f"{line.format} has 7 data bits, but {device.name} speaks "
                f"{device.driver.protocol}, which needs 8, such as 8{line.format[1:]}",
            )


def _check_listening(devices: Sequence[DeviceSettings], path: Path, mistakes: Mistakes) -> None:
    """Of what comes unasked nobody could tell which of two devices said it."""
    speakers = [
        device.name
        for device in devices
        if isinstance(device.driver, Unsolicited) and device.driver.sends_unsolicited
    ]
    for name in speakers[1:]:
        mistakes.add(
            (*path, "devices", name, "listen"),
            f"{speakers[0]} on this line speaks unasked already, and nobody could tell which of "
            "them did: give it a line of its own, or write both as one device",
        )


def _check_network(
    line: LineSection,
    devices: Sequence[DeviceSettings],
    device: DeviceSettings,
    path: Path,
    mistakes: Mistakes,
) -> None:
    protocol = device.driver.protocol
    if not isinstance(line.port, (TcpAddress, SimulatorAddress)):
        mistakes.add(
            (*path, "protocol"), f"{protocol} needs a port tcp://host:port, it has no wire"
        )
    wired = [other for other in devices if custom(other.driver).baudrate is not None]
    if wired:
        mistakes.add(
            (*path, "protocol"),
            f"{protocol} cannot share a line with {wired[0].name}, "
            f"which speaks {wired[0].driver.protocol}: give it a line of its own",
        )


def line_wire(
    line: LineSection, devices: Sequence[DeviceSettings], path: Path, mistakes: Mistakes
) -> tuple[SerialSettings, WireTiming]:
    """Speed and format, as written or as all protocols of the line are used to."""
    customs = {device.driver.protocol: custom(device.driver) for device in devices}
    rates = {name: habit.baudrate for name, habit in customs.items()}
    formats = {name: habit.format for name, habit in customs.items()}
    if line.baudrate is None and set(rates.values()) == {None}:
        return SerialSettings(), WireTiming(NETWORK_BAUD, 10)
    for setting, given, usual in (
        ("baudrate", line.baudrate, rates),
        ("format", line.format, formats),
    ):
        if given is None and len(set(usual.values())) > 1:
            habits = ", ".join(f"{name} {value}" for name, value in usual.items())
            mistakes.add(
                (*path, setting), f"missing: the devices of this line differ in it ({habits})"
            )
    baudrate = line.baudrate or next(filter(None, rates.values()), 9600)
    serial = SerialSettings(baudrate, line.format or next(iter(formats.values()), "8N1"))
    return serial, WireTiming(serial.baudrate, character_bits(serial.format))
