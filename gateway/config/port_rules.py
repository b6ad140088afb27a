"""Checks the port of a line: RS-485, connections that come and go, device servers that connect."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path as FilePath

from gateway.config.messages import Mistakes
from gateway.config.settings.model import ConnectionSection, LineSection
from gateway.config.settings.zenoh_records import tls_files
from gateway.engine.device.device_settings import DeviceSettings
from gateway.protocols.swapped import KnownReplies
from gateway.protocols.unsolicited import Unsolicited
from gateway.transport.port import (
    DeviceServer,
    ListenAddress,
    PortAddress,
    Reach,
    Rfc2217Address,
    SerialPath,
    TcpAddress,
    TlsConfig,
    UdpAddress,
)
from gateway.transport.rs485 import LONGEST_DELAY, Rs485

ONLY_READS = "a port udp:// only reads, because a datagram may arrive twice or late"
LONGEST_CONNECT_DELAY = 10.0  # seconds
SHOWS_ONE = "the side that listens shows a certificate: write certificate and key"
LONGEST_KEEPALIVE = 3600.0  # seconds
MOST_ADDRESSES = 3  # of a device server, besides the port


def port_of(line: LineSection, folder: FilePath, mistakes: Mistakes) -> PortAddress:
    """Returns the port, with its certificates and the device server that it waits for."""
    port, own = line.port, line.device_server
    tls = None
    if line.tls is not None:
        tls = tls_files(line.tls.record(), folder, mistakes.at("tls"))
    if isinstance(port, TcpAddress) and port.tls is not None and tls is not None:
        port = replace(port, tls=tls)
    if line.connection is not None:
        reach = _reach(line.connection, mistakes)
        if isinstance(port, TcpAddress | Rfc2217Address) and not line.serve:
            port = replace(port, reach=reach)
        else:
            text = "only a port tcp://, tls:// or rfc2217:// that the gateway connects to has it"
            mistakes.add(text, "connection")
    if not isinstance(port, ListenAddress):
        if own is not None:
            text = "the line waits for no device server: its port is not listen://host:port"
            mistakes.add(text, "device_server")
        return port
    if line.serve:
        text = "a line with `serve: true` is the one that listens: write the port as tcp://"
        mistakes.add(text, "port")
    name = ""
    if tls is not None:
        name, port = tls.name, replace(port, tls=replace(tls, name=""))
    if own is None:
        return replace(port, server=DeviceServer(name=name))
    words = (own.registration or b"", own.heartbeat or b"")
    return replace(port, server=DeviceServer(*words, own.allow or (), name))


def _reach(own: ConnectionSection, mistakes: Mistakes) -> Reach:
    if not 1 <= own.keepalive <= LONGEST_KEEPALIVE:
        text = "the system asks after 1s to 1h of silence: write 20s"
        mistakes.add(text, "connection", "keepalive")
    if len(own.also) > MOST_ADDRESSES:
        text = f"at most {MOST_ADDRESSES} more addresses: each gets its share of 5 s"
        mistakes.add(text, "connection", "also")
    return Reach(tuple(own.also), own.bind, own.keepalive)


def check_device_servers(lines: Mapping[str, PortAddress], mistakes: Mistakes) -> None:
    """Refuses two lines that one device server could mean. `lines`: their ports by name."""
    met: dict[tuple[str, int], dict[str, bytes]] = {}
    secured: dict[tuple[str, int], TlsConfig | None] = {}
    for name, port in lines.items():
        if not isinstance(port, ListenAddress):
            continue
        if secured.setdefault((port.host, port.port), port.tls) != port.tls:
            text = "another line has this port too: all have the same certificates, but `name`"
            mistakes.add(text, "lines", name, "tls")
        others = met.setdefault((port.host, port.port), {})
        mine, place = port.server.registration, ("lines", name, "device_server")
        for other, its in others.items():
            if mine.startswith(its) or its.startswith(mine):
                text = f"line {other} has this port too: give both a `registration`, such as "
                text += "{registration: DTU-0042}, that does not begin with the other one"
                mistakes.add(text, *place)
                break
        others[name] = mine


def check_heartbeat(
    line: LineSection, devices: Sequence[DeviceSettings], mistakes: Mistakes
) -> None:
    """Refuses a word of a device server with which replies begin: the word is dropped."""
    own = line.device_server
    for name in ("registration", "heartbeat") if own is not None else ():
        word: bytes = getattr(own, name) or b""
        for device in devices if word else ():
            driver = device.driver
            starts = driver.reply_starts if isinstance(driver, KnownReplies) else ()
            if any(one.startswith(word) or word.startswith(one) for one in starts):
                text = f"replies of {device.name} begin with it, and it is dropped from what "
                text += "arrives: set another one in the device server, such as the text ping"
                mistakes.add(text, "device_server", name)


def check_tls(line: LineSection, devices: Sequence[DeviceSettings], mistakes: Mistakes) -> None:
    """The side that connects needs an authority, the other one a certificate."""
    port, own, mistakes = line.port, line.tls, mistakes.at("tls")
    secured = isinstance(port, TcpAddress) and port.tls is not None
    masters = line.serve and any(one.driver.traits.over_network for one in devices)
    listens = masters or isinstance(port, ListenAddress)
    if own is None:
        if secured:
            need = "certificate: gateway.pem, key: gateway.key" if listens else "ca: ca.pem"
            mistakes.add(f"missing: a port tls:// needs `tls: {{{need}}}`")
        return
    if not secured and not isinstance(port, ListenAddress):
        mistakes.add("certificates are for a port tls:// or listen://: this one has no TLS")
    if listens and own.certificate is None:
        mistakes.add(SHOWS_ONE)
    if not listens and own.ca is None:
        mistakes.add("write the authority that signs the certificate there, as `ca`")
    if own.writers and not (masters and own.mutual):
        text = (
            "roles are in the certificates of masters: they need `serve: true` and `mutual: true`"
        )
        mistakes.add(text, "writers")
    if own.name and (masters or (listens and not own.mutual)):
        text = "no certificate of the other side has to have one name: it needs `mutual: true`"
        mistakes.add("masters have roles: `writers`" if masters else text, "name")


def check_connection(
    line: LineSection, devices: Sequence[DeviceSettings], mistakes: Mistakes
) -> None:
    """A connection that comes and goes must suit the port, the devices and their intervals."""
    delay, rounds, own = line.connect_delay, line.close_after, mistakes.at("close_after")
    for setting in ("connect_delay", "close_after"):
        if getattr(line, setting) and not isinstance(line.port, TcpAddress | Rfc2217Address):
            text = "is a setting of a port tcp:// or rfc2217://: no other has a connection"
            mistakes.add(f"{setting} {text}", setting)
    if delay > LONGEST_CONNECT_DELAY:
        text = f"a delay is at most {LONGEST_CONNECT_DELAY:g}s: requests wait for it"
        mistakes.add(text, "connect_delay")
    if rounds and (line.serve or line.listen_only):
        own.add("another master decides when this line speaks: remove close_after")
    for device in devices if rounds else ():
        if isinstance(device.driver, Unsolicited) and device.driver.sends_unsolicited:
            text = f"{device.name} sends unsolicited frames, which a closed connection loses"
            own.add(text)
        short = min((tag.every for tag in device.wire_tags if tag.polled), default=2 * delay)
        if short < 2 * delay:
            text = f"{device.name} has an interval of {short:g} s, and each round waits {delay:g} s"
            own.add(f"{text} (connect_delay): write every: {2 * delay:g}s or more")


def check_datagrams(
    line: LineSection, devices: Sequence[DeviceSettings], mistakes: Mistakes
) -> None:
    """A datagram may arrive twice, late, or after a later one. Only numbered frames can be told
    apart then, and a write could be done again after a newer one."""
    if not isinstance(line.port, UdpAddress):
        return
    if line.serve:
        mistakes.add("a served line has a port tcp://: datagrams have no master", "port")
    for device in devices:
        own = mistakes.at("devices", device.name)
        if not device.driver.traits.over_network:
            text = f"{device.driver.protocol} has no number in its frames, and datagrams may change"
            own.add(f"{text} their order: only modbus-tcp has udp://", "protocol")
        for name in [tag.name for tag in device.tags if tag.write is not None]:
            text = "and an old write would be done after a newer one: remove `write`, or use tcp://"
            own.add(f"{ONLY_READS}, {text}", "tags", name, "write")
        if device.control:
            text = f"{ONLY_READS}: use tcp://, or remove `control`"
            own.add(text, "control")


def direction(line: LineSection, mistakes: Mistakes) -> Rs485 | None:
    """Returns how RTS switches the transceiver; None: it is not switched."""
    own = line.rs485
    if own is None:
        return None
    if not isinstance(line.port, SerialPath):
        text = "rs485 is a setting of a serial port of this computer: a device server has its own"
        mistakes.add(text, "rs485")
    for name, delay in (("before", own.before), ("after", own.after)):
        if delay > LONGEST_DELAY or abs(delay * 1e3 - round(delay * 1e3)) > 1e-6:
            text = "Linux waits whole milliseconds, at most 100ms: write 0ms, 1ms, 2ms"
            mistakes.add(text, "rs485", name)
    by_hand = own.by == "program"
    return Rs485(own.rts == "send", own.before, own.after, bool(line.echo), by_hand)
