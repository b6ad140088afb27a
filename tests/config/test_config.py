"""The configuration file: what it becomes, and what is said about its mistakes."""

import gc
import json
import tempfile
import textwrap
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.config import Config, ConfigErrors, load
from gateway.config import schema as made_schema
from gateway.config.messages import one_of
from gateway.config.settings import parsers
from gateway.config.settings.session_model import Section, ZenohSection
from gateway.config.tags.section import TagDefaults
from gateway.config.yaml.file import read_yaml
from gateway.errors import ConfigError
from gateway.parts.history.settings import HistorySection
from gateway.parts.web.settings import WebSection
from gateway.planning.wire_timing import NETWORK_BAUD
from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.driver import Address, Span, Unit
from gateway.protocols.modbus import ModbusRtu, ModbusTcp
from gateway.protocols.registry import PROTOCOLS
from gateway.protocols.vigor import Vigor
from gateway.tags import Deadband, Form, Publish, Tag, WriteRule
from gateway.transport.port import Rfc2217Address, SerialPath, SimulatorAddress, TcpAddress
from gateway.values import Kind, Order, ValueType
from tests.schema_check import violations

EXAMPLE = Path(__file__).parents[2] / "config.example.yaml"
schema = cache(made_schema)  # it takes a quarter of a second

CONTRACT = """\
gateway: {name: demo}
zenoh: {prefix: plant, mode: peer, listen: [tcp/127.0.0.1:7447], connect: [], config_file: null}
history: {path: history.db, keep: 7d, max_size: 1GB}
web: {listen: 127.0.0.1:8080}
defaults: {every: 1s}
lines:
  hall-1:
    port: /dev/ttyUSB0
    baudrate: 19200
    format: 7E1
    devices:
      mixer:
        protocol: vigor
        station: 1
        reply_timeout: 500ms
        tags:
          speed:       {address: D100, scale: 0.1, unit: rpm, every: 500ms, deadband: 0.5}
          level:       {address: D10, type: float32}
          batches:     {address: C200}
          alarms/door: {address: M12, description: Guard door open}
          valve:       {address: D7.3}
          name:        {address: D600, type: "string[16]"}
          recipe:      {address: D500, write: {min: 1, max: 40, verify: true}}
          run:         {address: Y20, write: true}
      oven:
        protocol: computer-link
        station: 5
        frame_format: 4
        sum_check: true
        message_wait: 20ms
        tags: {temperature: {address: D0100, type: int16}}
  hall-2:
    port: tcp://10.0.0.7:4001
    baudrate: 9600
    format: 8E1
    devices:
      plc:   {protocol: modbus-rtu, station: 3, addressing: k120s, tags: {run: {address: M0010}, n: {address: D0100}}}
      meter: {protocol: modbus-rtu, station: 9, tags: {power: {address: "input:100", type: float32, word_order: high_first}}}
"""  # noqa: E501  as the contract prints it


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str | bytes], Config]:
    """Loads a text as `plant.yaml`."""
    monkeypatch.chdir(tmp_path)

    def loaded(text: str | bytes) -> Config:
        data = text if isinstance(text, bytes) else text.encode()
        Path("plant.yaml").write_bytes(data)
        return load("plant.yaml")

    return loaded


def on_line(rows: str) -> str:
    """A file with one line `hall`; `rows` begin in line 3."""
    return "lines:\n  hall:\n" + textwrap.indent(textwrap.dedent(rows), "    ")


def on_mixer(rows: str) -> str:
    """A file with one device `mixer`; `rows` begin in line 6."""
    return on_line("port: simulator\ndevices:\n  mixer:\n" + textwrap.indent(rows, "    "))


def tags(*rows: str) -> str:
    """A file with one Vigor and these tags, which begin in line 8."""
    return on_mixer("protocol: vigor\ntags:\n" + "".join(f"  {row}\n" for row in rows))


def only_tag(config: Config) -> Tag:
    (tag,) = config.devices[0].tags
    return tag


M = "lines.hall.devices.mixer"
TYPES = (
    "bool, int8, uint8, int16, uint16, int32, uint32, int64, uint64, float32, float64, bcd16, "
    "bcd32, telephone"
)


@dataclass(frozen=True)
class Bad:
    what: str
    text: str | bytes
    says: tuple[str, ...]

    def __repr__(self) -> str:
        return self.what.replace(" ", "-")


def bad(what: str, text: str | bytes, *says: str) -> Bad:
    return Bad(what, text, says)


UNREADABLE = [
    bad("empty", "", "1: the file is empty: it needs at least `lines:`"),
    bad("only comments", "# later\n", "1: the file is empty: it needs at least `lines:`"),
    bad(
        "a list",
        "# my plant\n- a\n",
        "2: no settings: a file begins with names such as `gateway:` and `lines:`, "
        "each with a colon",
    ),
    bad("tab", "lines:\n\thall:\n", "2: a tab: YAML is indented with spaces"),
    bad("tab after a dash", "zenoh:\n  -\ta: 3\n", "2: a tab: YAML is indented with spaces"),
    bad(
        "open bracket",
        "zenoh:\n  listen: [tcp/a:1\nlines: 3\n",
        "3: no YAML: while parsing a flow sequence that begins in line 2, "
        "did not find expected ',' or ']': check commas and brackets, "
        "and put a text with one of , : [ ] { } # in it in quotes",
    ),
    bad(
        "two colons",
        "gateway:\n  name: a: b\n",
        "2: no YAML: mapping values are not allowed in this context: check indentation and "
        "colons of this line and the one before, and put a text with `: ` in it in quotes",
    ),
    bad(
        "indented too far",
        tags("a: {address: D1}", "  b: {address: D2}"),
        "9: no YAML: while parsing a block mapping that begins in line 8, "
        "did not find expected key: check the indentation of this line and the one before",
    ),
    bad(
        "colon left out",
        tags("a: {address: D1}", "b", "c: {address: D3}"),
        "9: no colon after b: write b:",
    ),
    bad(
        "percent without quotes",
        tags("a: {address: D1, unit: %}"),
        "8: no YAML: while scanning for the next token, found character that cannot start any "
        "token: put a text that begins with one of % @ ` & * ! | > in quotes",
    ),
    bad(
        "bracket without quotes",
        tags("a: {address: D1, type: string[16]}"),
        "8: no YAML: while parsing a flow mapping, did not find expected ',' or '}': check "
        "commas and brackets, and put a text with one of , : [ ] { } # in it in quotes",
    ),
    bad(
        "quote left open",
        tags("a: {address: D1, unit: 'rpm}"),
        "9: no YAML: while scanning a quoted scalar that begins in line 8, "
        "found unexpected end of stream: close the quote",
    ),
    bad(
        "backslash in double quotes",
        tags('a: {address: D1, description: "C:\\plant"}'),
        "8: no YAML: while parsing a quoted scalar, found unknown escape character: "
        "in double quotes a backslash begins an escape: use single quotes",
    ),
    *(
        bad(
            f"{what} without end",
            begin + more * 50_000,
            "2: more than 50 levels deep: look for a bracket or a dash too many",
        )
        for what, begin, more in (
            ("brackets", "zenoh: {}\nlines: ", "["),
            ("braces", "zenoh: {}\nlines: ", "{a: "),
            ("dashes", "lines:\n  ", "- "),
            ("questions", "lines:\n  ", "? "),
        )
    ),
    bad("not UTF-8", b"gateway:\n  name: M\xfcller\n", "2: byte 0xfc is no UTF-8: "
        "save the file as UTF-8"),
    bad("UTF-16", "lines:".encode("utf-16"), "1: the file is UTF-16: save it as UTF-8"),
    bad("control character", "lines:\n  \x01: 3\n", "2: a control character: delete it"),
    bad(
        "two documents",
        "lines: {}\n---\nlines: {}\n",
        "2: a second document (`---`): a configuration is one document",
    ),
    bad("unknown anchor", "\nlines: *hall\n", "2: an alias (*) without its anchor (&) before it"),
    bad("anchor in itself", "lines: &a\n  hall: *a\n", "1: its anchors repeat without end"),
]  # fmt: skip

SECTIONS = [
    bad("no lines", "gateway: {name: x}\n", "1: lines: missing: the file needs it"),
    bad("empty lines", "lines: {}\n", "1: lines: no lines: a gateway has at least one"),
    bad(
        "unknown section",
        tags("speed: {address: D1}") + "zeno: {}\n",
        "9: zeno: no setting of the file: did you mean zenoh?",
    ),
    bad(
        "duplicate section",
        "zenoh: {}\n" + tags("speed: {address: D1}") + "zenoh: {}\n",
        "1: zenoh: written twice, here and again in line 10: only one of them can be meant",
    ),
    bad(
        "gateway name",
        "gateway: {name: my gateway}\n" + tags("speed: {address: D1}"),
        "1: gateway.name: 'my gateway' has a space: names are letters and digits, `_`, `-`, `.`",
    ),
    bad(
        "prefix with a wildcard",
        "zenoh: {prefix: plant/**}\n" + tags("speed: {address: D1}"),
        "1: zenoh.prefix: 'plant/**' has *, a wildcard of Zenoh: remove it",
    ),
    bad(
        "prefix with an at sign",
        'zenoh: {prefix: "@plant"}\n' + tags("speed: {address: D1}"),
        "1: zenoh.prefix: '@plant': chunks with @ are reserved for the gateway: remove the @",
    ),
    bad(
        "prefix with a slash at its end",
        "zenoh: {prefix: plant/}\n" + tags("speed: {address: D1}"),
        "1: zenoh.prefix: 'plant/': one `/` separates the chunks of a prefix",
    ),
    bad(
        "zenoh settings",
        "zenoh:\n  mode: server\n  listen: tcp/127.0.0.1:7447\n  connect: [10.0.0.1]\n"
        "  config_file: zenoh.json5\n" + tags("speed: {address: D1}"),
        "2: zenoh.mode: 'server' is not known: use peer, client or router",
        "3: zenoh.listen: 'tcp/127.0.0.1:7447' is no list: write it as [first, second]",
        "4: zenoh.connect[0]: '10.0.0.1' is no Zenoh endpoint: write tcp/127.0.0.1:7447",
        "5: zenoh.config_file: there is no file zenoh.json5",
    ),
    bad(
        "history settings",
        "history: {path: 3, keep: 7, max_size: 1}\n" + tags("speed: {address: D1}"),
        "1: history.path: 3 is no file name",
        "1: history.keep: 7 has no unit: write 7s or 7ms",
        "1: history.max_size: 1 is no size: write 500MB or 1GB",
    ),
    bad(
        "history in the file of the state",
        "gateway:\n  state: data/../history.db\nhistory: {keep: 7d}\n"
        + tags("speed: {address: D1}"),
        "2: gateway.state: history is kept in history.db: two files are needed, such as "
        "history.db and state.json",
    ),
    bad(
        "history without its section",
        tags("speed: {address: D1}", "level: {address: D2, history: true}"),
        f"9: {M}.tags.level.history: the file has no `history:` section: "
        "write `history: {path: history.db}` beside `lines:`",
    ),
    bad(
        "history by default without its section",
        "defaults: {history: true}\n" + tags("speed: {address: D1}", "level: {address: D2}"),
        f"9: {M}.tags.speed.history: the file has no `history:` section: "
        "write `history: {path: history.db}` beside `lines:`",
    ),
    bad(
        "web address",
        "web: {listen: 8080}\n" + tags("speed: {address: D1}"),
        "1: web.listen: 8080 is no address to listen on: write 127.0.0.1:8080",
    ),
    bad(
        "web for other machines",
        'web: {listen: "0.0.0.0:8080"}\n' + tags("speed: {address: D1}"),
        "1: web.listen: other machines can reach 0.0.0.0: name a tokens_file too (see "
        "docs/page.md), or listen on 127.0.0.1:8080",
    ),
    bad(
        "web names",
        "web: {names: [gateway.plant:8080]}\n" + tags("speed: {address: D1}"),
        "1: web.names[0]: 'gateway.plant:8080' is no name of a machine: write gateway.plant, "
        "without a port",
    ),
    bad(
        "defaults",
        "defaults:\n  evry: 1s\n  every: 0s\n  scale: 0\n" + tags("speed: {address: D1}"),
        "2: defaults.evry: no setting of defaults: did you mean every?",
        "3: defaults.every: 0s: an interval is longer than zero, such as 500ms",
        "4: defaults.scale: a scale of 0 makes every value the same",
    ),
    bad(
        "a Python object",
        "gateway: {name: !!python/name:os.system x}\n" + tags("speed: {address: D1}"),
        "1: gateway.name: 'tag:yaml.org,2002:python/name:os.system' cannot be used here: "
        "write the value alone",
        "1: gateway.name: nothing is no text",
    ),
]

LINES = [
    bad(
        "line without port",
        on_line("devices: {mixer: {protocol: vigor}}"),
        "2: lines.hall.port: missing: a line needs it",
    ),
    bad(
        "line without devices",
        on_line("port: simulator\ndevices: {}"),
        "4: lines.hall.devices: no devices: a line has at least one",
    ),
    bad(
        "line settings",
        on_line(
            "port: http://10.0.0.7:4001\nbaudrate: 1920\nformat: 7X1\necho: maybe\n"
            "parity: even\ndevices: {mixer: {protocol: vigor}}"
        ),
        "3: lines.hall.port: 'http://10.0.0.7:4001' is not a port: write a path such as "
        "/dev/ttyUSB0, tcp://host:port, tls://host:port, udp://host:port, rfc2217://host:port, "
        "listen://host:port, modem:/dev/ttyS0, or simulator",
        "4: lines.hall.baudrate: 1920 is no baud rate of serial ports; the nearest is 2400",
        "5: lines.hall.format: '7X1' is no character format: write data bits (7 or 8), parity "
        "(N, E or O) and stop bits (1 or 2), such as 7E1",
        "6: lines.hall.echo: 'maybe' is neither true nor false",
        "7: lines.hall.parity: no setting of a line: "
        "use port, baudrate, format, origin, echo, rs485, device_server, tls, connection, serve, "
        "request_gap, listen_only, modem, connect_delay, close_after, defaults or devices",
    ),
    bad(
        "negative baud rate",
        on_line("port: /dev/ttyS3\nbaudrate: -9600\ndevices: {mixer: {protocol: vigor}}"),
        "4: lines.hall.baudrate: -9600 is no baud rate of serial ports; the nearest is 110",
    ),
    bad(
        "direction of a device server, and a delay that the kernel has not",
        on_line("port: tcp://10.0.0.7:4001\nrs485: {rts: send, after: 1.5ms}\n"
                "devices: {mixer: {protocol: vigor}}"),
        "4: lines.hall.rs485: rs485 is a setting of a serial port of this computer: a device "
        "server has its own",
        "4: lines.hall.rs485.after: Linux waits whole milliseconds, at most 100ms: write 0ms, 1ms, "
        "2ms",
    ),
    bad(
        "connections of a port that has none",
        on_line("port: /dev/ttyS3\nclose_after: round\nconnect_delay: 11s\n"
                "devices: {mixer: {protocol: vigor}}"),
        "4: lines.hall.close_after: close_after is a setting of a port tcp:// or rfc2217://: no "
        "other has a connection",
        "5: lines.hall.connect_delay: connect_delay is a setting of a port tcp:// or rfc2217://: "
        "no other has a connection",
        "5: lines.hall.connect_delay: a delay is at most 10s: requests wait for it",
    ),
    bad(
        "a heartbeat that begins every reply",
        on_line("port: listen://0.0.0.0:5020\n"
                "device_server: {registration: DTU-1, heartbeat: <01>}\n"
                "devices: {pump: {protocol: modbus-rtu, station: 1}}"),
        "4: lines.hall.device_server.heartbeat: replies of pump begin with it, and it is dropped "
        "from what arrives: set another one in the device server, such as the text ping",
    ),
    bad(
        "rounds that another master decides, and whose delay is longer than a round",
        on_line("port: tcp://10.0.0.7:4001\nlisten_only: true\nclose_after: round\n"
                "connect_delay: 2s\n"
                "devices: {mixer: {protocol: vigor, tags: {t: {address: D1, every: 3s}}}}"),
        "5: lines.hall.close_after: another master decides when this line speaks: remove "
        "close_after",
        "5: lines.hall.close_after: mixer has an interval of 3 s, and each round waits 2 s "
        "(connect_delay): write every: 4s or more",
    ),
    bad(
        "port number",
        on_line("port: tcp://10.0.0.7:70000\ndevices: {mixer: {protocol: vigor}}"),
        "3: lines.hall.port: port number 70000 is not 1..65535",
    ),
    bad(
        "a format that the manual does not have",
        on_line("port: simulator\nformat: 8N1\ndevices:\n"
                "  mixer: {protocol: vigor, station: 1}\n"
                "  oven: {protocol: vigor, station: 2}"),
        "4: lines.hall.format: 8N1, but mixer and 1 more speak vigor, which is 7E1 by its manual "
        "or its own `format`. "
        "If the ports are really set to 8N1, write `format: 8N1` there too",
    ),
    bad(
        "protocols of 7 and of 8 bits",
        on_line("port: simulator\nbaudrate: 9600\nformat: 8E1\ndevices:\n"
                "  mixer: {protocol: vigor, station: 1}\n"
                "  oven: {protocol: modbus-rtu, station: 2}"),
        "5: lines.hall.format: 8E1, but mixer speaks vigor, which is 7E1 by its manual or "
        "its own `format`. oven "
        "(modbus-rtu) needs 8 data bits: use two ports, or vigor devices in their Modbus mode",
    ),
    bad(
        "a format of a device that is none",
        on_mixer("protocol: vigor\nformat: 9N1"),
        f"7: {M}.format: 9N1 is no character format such as 8N1",
    ),
    bad(
        "one port twice",
        "lines:\n"
        "  a: {port: /dev/ttyUSB0, devices: {mixer: {protocol: vigor}}}\n"
        "  b: {port: /dev/ttyUSB0, devices: {oven: {protocol: vigor}}}\n",
        "3: lines.b.port: line a has this port already: one port is one line, "
        "with all its devices",
    ),
    bad(
        "7 bits for binary frames",
        on_line("port: simulator\nformat: 7E1\ndevices: {plc: {protocol: modbus-rtu, station: 1}}"),
        "4: lines.hall.format: 7E1 has 7 data bits, but plc speaks modbus-rtu, "
        "which needs 8, such as 8E1",
    ),
    bad(
        "defaults that differ",
        on_line("port: /dev/ttyS3\ndevices:\n  a: {protocol: vigor, station: 1}\n"
                "  b: {protocol: modbus-rtu, station: 2}"),
        "2: lines.hall.baudrate: missing: the devices of this line differ in it "
        "(vigor 19200, modbus-rtu 9600)",
        "2: lines.hall.format: missing: the devices of this line differ in it "
        "(vigor 7E1, modbus-rtu 8E1)",
    ),
    bad(
        "modbus-tcp on a wire",
        on_line("port: /dev/ttyS3\ndevices:\n  a: {protocol: modbus-tcp, station: 1}"),
        "5: lines.hall.devices.a.protocol: modbus-tcp needs a port tcp://host:port, "
        "udp://host:port or listen://host:port: it does not run on a serial line",
    ),
    bad(
        "datagrams that write",
        on_line("port: udp://a:502\ndevices:\n  a: {protocol: modbus-tcp, station: 1, "
                "control: true,\n    tags: {x: {address: 'holding:0', write: true}}}"),
        "5: lines.hall.devices.a.control: a port udp:// only reads, because a datagram may arrive "
        "twice or late: use tcp://, or remove `control`",
        "6: lines.hall.devices.a.tags.x.write: a port udp:// only reads, because a datagram may "
        "arrive twice or late, and an old write would be done after a newer one: remove `write`, "
        "or use tcp://",
    ),
    bad(
        "datagrams without a number",
        on_line("port: udp://a:502\ndevices:\n  a: {protocol: modbus-rtu, station: 1}"),
        "5: lines.hall.devices.a.protocol: modbus-rtu has no number in its frames, and datagrams "
        "may change their order: only modbus-tcp has udp://",
    ),
    bad(
        "modbus-tcp beside a serial protocol",
        on_line("port: tcp://a:502\nbaudrate: 9600\nformat: 8E1\ndevices:\n"
                "  a: {protocol: modbus-tcp, station: 1}\n  b: {protocol: modbus-rtu, station: 2}"),
        "7: lines.hall.devices.a.protocol: modbus-tcp cannot share a line with b, "
        "which speaks modbus-rtu: give it a line of its own",
    ),
]  # fmt: skip

DEVICES = [
    bad(
        "no protocol",
        on_mixer("station: 1"),
        f"5: {M}.protocol: missing: a device needs its protocol: {one_of(PROTOCOLS)}",
    ),
    bad(
        "unknown protocol",
        on_mixer("protocol: modbus"),
        f"6: {M}.protocol: 'modbus' is no protocol: did you mean modbus-tcp?",
    ),
    bad("no settings", on_mixer(""), f"5: {M}: nothing stands where settings are expected, "
        "each as `name: value`"),
    bad(
        "station out of range",
        on_mixer("protocol: vigor\nstation: 256"),
        f"7: {M}.station: station 256 is not 0..255",
    ),
    bad(
        "station of another type",
        on_mixer("protocol: vigor\nstation: true"),
        f"7: {M}.station: true is no whole number",
    ),
    bad(
        "no station",
        on_mixer("protocol: modbus-rtu\ntags: {}"),
        f"5: {M}.station: missing: a modbus-rtu device needs it",
    ),
    bad(
        "one station number twice",
        on_line("port: simulator\nbaudrate: 9600\nformat: 7E1\ndevices:\n"
                "  mixer: {protocol: vigor, station: 5}\n"
                "  oven:\n    protocol: vigor\n    station: 5"),
        "10: lines.hall.devices.oven.station: mixer on this line is station 5 already: "
        "both would answer at once",
    ),
    bad(
        "one name on two lines",
        "lines:\n"
        "  a: {port: simulator, devices: {mixer: {protocol: vigor}}}\n"
        "  b: {port: simulator, devices: {mixer: {protocol: vigor}}}\n",
        "3: lines.b.devices.mixer: a device mixer is already on line a: "
        "a name is used once in the file, it is the key of the values",
    ),
    bad(
        "one name typed in two ways",
        "lines:\n  a:\n    port: simulator\n    devices:\n"
        "      m\u00fchle: {protocol: vigor, station: 1}\n"
        "      mu\u0308hle: {protocol: vigor, station: 2}\n",
        "6: lines.a.devices.mu\u0308hle: a device m\u00fchle is already on line a: "
        "a name is used once in the file, it is the key of the values",
    ),
    bad(
        "duplicate device",
        on_line("port: simulator\ndevices:\n  mixer: {protocol: vigor}\n"
                "  mixer: {protocol: vigor, station: 2}"),
        f"5: {M}: written twice, here and again in line 6: only one of them can be meant",
    ),
    bad(
        "device name",
        on_line("port: simulator\ndevices:\n  hall/mixer: {protocol: vigor}"),
        "5: lines.hall.devices.hall/mixer: 'hall/mixer' has a `/`: "
        "names are letters and digits, `_`, `-`, `.`",
    ),
    bad(
        "device settings",
        on_mixer("protocol: vigor\nreply_timeout: 0s\nturnaround: 5\nretries: 99\n"
                 "silence: short\nlate_guard: 1M\nblocks: 1\nreplytimeout: 1s"),
        f"7: {M}.reply_timeout: 0s: an interval is longer than zero, such as 500ms",
        f"8: {M}.turnaround: 5 has no unit: write 5s or 5ms",
        f"9: {M}.retries: 99 is above 10",
        f"10: {M}.silence: 'short' is no duration: write 500ms, 2s, 15min, 1h30m or 7d",
        f"11: {M}.late_guard: 1M: M is no unit of time: use min for minutes",
        f"12: {M}.blocks: 1 is not known: use true, false or only",
        f"13: {M}.replytimeout: no setting of a vigor device: did you mean reply_timeout?",
    ),
    bad(
        "another protocol's setting",
        on_mixer("protocol: vigor\nframe_format: 4"),
        f"7: {M}.frame_format: no setting of a vigor device: use accept, blocks, control, "
        "defaults, enabled, format, identity, late_guard, reply_timeout, retries, silence, "
        "stale_after, station, tags, tags_from, turnaround or verify_reads",
    ),
    bad(
        "a protocol's own settings",
        on_mixer("protocol: computer-link\nframe_format: 2\nsum_check: 1\nmessage_wait: 10"),
        f"7: {M}.frame_format: 2 is not known: use 1 or 4",
        f"8: {M}.sum_check: 1 is neither true nor false",
        f"9: {M}.message_wait: 10 has no unit: write 10s or 10ms",
    ),
    bad(
        "a setting its protocol cannot take",
        on_mixer("protocol: computer-link\nmessage_wait: 155ms"),
        f"7: {M}.message_wait: message_wait is 0ms to 150ms in steps of 10ms",
    ),
]  # fmt: skip

TAGS = [
    bad(
        "no address",
        tags("speed: {adress: D100}"),
        f"8: {M}.tags.speed.adress: no setting of a tag: did you mean address?",
    ),
    bad(
        "octal 8",
        tags("door: {address: X18}"),
        f"8: {M}.tags.door.address: X18: X and Y are numbered in octal, 8 and 9 do not exist",
    ),
    bad(
        "address out of range",
        tags("a: {address: D8192}"),
        f"8: {M}.tags.a.address: D8192: D goes from D0 to D8191 and D9000 to D9255",
    ),
    bad(
        "no such device letter",
        tags("a: {address: R100}"),
        f"8: {M}.tags.a.address: R100: there is no device R; "
        "there are X, Y, M, S, TS, CS, TC, CC, T, D, C, TN, CN",
    ),
    bad(
        "bit 16",
        tags("a: {address: D7.16}"),
        f"8: {M}.tags.a.address: D7.16: the bits of a word are .0 to .15",
    ),
    bad(
        "past the end",
        tags("a: {address: D8191, type: float32}"),
        f"8: {M}.tags.a.address: a float32 at D8191 takes 2 words, but the last is D8191",
    ),
    bad(
        "word type for a bit",
        tags("a: {address: M12, type: int16}", "b: {address: D7.3, type: int16}"),
        f"8: {M}.tags.a.type: M12 is a bit: it can only be bool",
        f"9: {M}.tags.b.type: D7.3 is one bit of a word: it can only be bool",
    ),
    bad(
        "bool for a word",
        tags("a: {address: D100, type: bool}"),
        f"8: {M}.tags.a.type: D100 is a word: for one of its bits write D100.0, "
        "or name a type for the word",
    ),
    bad(
        "16 bits of a 32-bit counter",
        tags("a: {address: C200, type: int16}", 'b: {address: C201, type: "string[4]"}'),
        f"8: {M}.tags.a.type: C200 has 32 bits, no int16: "
        "use one of int32, uint32, float32, bcd32",
        f"9: {M}.tags.b.type: C201 has 32 bits, no string[4]: "
        "use one of int32, uint32, float32, bcd32",
    ),
    bad(
        "order of a 32-bit counter",
        tags("a: {address: C200, word_order: high_first}"),
        f"8: {M}.tags.a.word_order: C200 has 32 bits by nature: it needs no word_order",
    ),
    bad(
        "order of what has none",
        tags("a: {address: M1, word_order: low_first}", "b: {address: D1.3, byte_order: low_first}",
             "c: {address: D1, word_order: high_first}",
             'd: {address: D1, type: "string[4]", word_order: high_first}'),
        f"8: {M}.tags.a.word_order: M1 is bool: only numbers of 32 or 64 bits have a word_order",
        f"9: {M}.tags.b.byte_order: D1.3 is bool: only words have a byte_order",
        f"10: {M}.tags.c.word_order: D1 is int16: only numbers of 32 or 64 bits have a word_order",
        f"11: {M}.tags.d.word_order: D1 is string[4]: only numbers of 32 or 64 bits have a "
        "word_order",
    ),
    bad(
        "numbers beyond all measure",
        tags(f"a: {{address: D1, every: {10**299}}}", f"b: {{address: D1, scale: 0x{'f' * 300}}}",
             f"c: {{address: D1, scale: {'9' * 5000}}}"),
        f"8: {M}.tags.a.every: such a large number is no duration: "
        "write 500ms, 2s, 15min, 1h30m or 7d",
        f"9: {M}.tags.b.scale: such a large number is no number",
        f"10: {M}.tags.c.scale: inf is no number that can be used",
    ),
    bad(
        "a limit between the device's steps",
        tags("a: {address: D1, scale: 0.1, write: {max: 1.35}}"),
        f"8: {M}.tags.a.write.max: 1.35 (the device holds 1.4) is above the greatest value 1.35",
    ),
    bad(
        "unknown type",
        tags("a: {address: D1, type: int, write: {max: 70000}}"),
        f"8: {M}.tags.a.type: 'int' is not a type: use {TYPES} or string[n], or "
        "an array such as uint16[50]",
    ),
    bad(
        "string too long",
        tags('a: {address: D1, type: "string[251]"}', 'b: {address: D1, type: "string[130]"}'),
        f"8: {M}.tags.a.type: string[251]: a string has 1 to 250 characters",
        f"9: {M}.tags.b.type: a string[130] is 65 words, more than one request can carry",
    ),
    bad(
        "numbers",
        tags("a: {address: D1, scale: 0}", "b: {address: D1, scale: big}",
             "c: {address: D1, offset: .nan}", "d: {address: D1, offset: true}"),
        f"8: {M}.tags.a.scale: a scale of 0 makes every value the same",
        f"9: {M}.tags.b.scale: 'big' is no number",
        f"10: {M}.tags.c.offset: nan is no number that can be used",
        f"11: {M}.tags.d.offset: true is no number",
    ),
    bad(
        "alarms",
        tags("a: {address: D1, alarm: {}}", "b: {address: D2, alarm: {high: 5, low: 7}}",
             "c: {address: D3, alarm: {on: true}}", "d: {address: M1, alarm: {high: 1}}",
             "e: {address: M2, alarm: {on: true, off: true}}",
             "f: {address: D4, alarm: {high: 5, low: 4, hysteresis: 1}}",
             "g: {address: D5, alarm: {high: 5, hysteresis: -1}}",
             'h: {address: D6, type: "string[2]", alarm: {high: 5}}',
             "i: {address: D7, alarm: {high: 0.8, low: 0.7, hysteresis: 0.1}}"),
        f"8: {M}.tags.a.alarm: an alarm needs a limit, such as high: 80, or for a bit on: true",
        f"9: {M}.tags.b.alarm: low 7 is not below high 5",
        f"10: {M}.tags.c.alarm: a int16 has limits, such as high: 80; only a bit has on and off",
        f"11: {M}.tags.d.alarm: a bool has no limits: write on: true, or off: true",
        f"12: {M}.tags.e.alarm: a bit has on: true or off: true, and no limit or hysteresis",
        f"13: {M}.tags.f.alarm: hysteresis must be less than 1, the distance of low and high",
        f"14: {M}.tags.g.alarm.hysteresis: -1 is no distance: it is zero or more",
        f"15: {M}.tags.h.alarm: a string[2] has no alarm: only numbers and bits have",
        f"16: {M}.tags.i.alarm: hysteresis must be less than 0.1, the distance of low and high",
    ),
    bad(
        "scale of a bit",
        tags("a: {address: M1, scale: 2}", "b: {address: D1.0, deadband: 1}",
             'c: {address: D1, type: "string[2]", offset: 1}'),
        f"8: {M}.tags.a.scale: a bool has no scale: only numbers have",
        f"9: {M}.tags.b.deadband: a bool has no deadband: only numbers have",
        f"10: {M}.tags.c.offset: a string[2] has no offset: only numbers have",
    ),
    bad(
        "interval",
        tags("a: {address: D1, every: 0s}", "b: {address: D1, every: 500}",
             "c: {address: D1, every: 1 hour}", "d: {address: D1, heartbeat: 0ms}",
             "e: {address: D1, every: -1s}", "f: {address: D1, every: 4000d}"),
        f"8: {M}.tags.a.every: 0s: an interval is longer than zero, such as 500ms",
        f"9: {M}.tags.b.every: 500 has no unit: write 500s or 500ms",
        f"10: {M}.tags.c.every: 1 hour: hour is no unit of time: use ms, s, min, h or d",
        f"11: {M}.tags.d.heartbeat: 0ms: an interval is longer than zero, such as 500ms",
        f"12: {M}.tags.e.every: '-1s' is no duration: write 500ms, 2s, 15min, 1h30m or 7d",
        f"13: {M}.tags.f.every: 4000d is longer than ten years",
    ),
    bad(
        "deadband",
        tags("a: {address: D1, deadband: -1}", "b: {address: D1, deadband: 5 rpm}",
             "c: {address: D1, deadband: 200%}", "d: {address: D1, deadband: .inf}"),
        f"8: {M}.tags.a.deadband: -1: a deadband is 0 or more",
        f"9: {M}.tags.b.deadband: '5 rpm' is no deadband: write 0.5 (in the unit of the tag) or 2%",
        f"10: {M}.tags.c.deadband: 200%: more than 100% would publish almost nothing",
        f"11: {M}.tags.d.deadband: inf: a deadband is 0 or more",
    ),
    bad(
        "choices",
        tags("a: {address: D1, publish: never}", "b: {address: D1, word_order: big}",
             "c: {address: D1, history: yes}"),
        f"8: {M}.tags.a.publish: 'never' is not known: use change or always",
        f"9: {M}.tags.b.word_order: 'big' is no order: use low_first or high_first",
        f"10: {M}.tags.c.history: 'yes' is neither true nor false",
    ),
    bad(
        "write",
        tags("a: {address: D1, write: maybe}", "b: {address: D1, write: {min: 5, max: 1}}",
             "c: {address: D1, write: {minimum: 5}}", "d: {address: M1, write: {min: 0}}",
             "e: {address: D1, write: {max: 70000}}", "f: {address: D1, write: {min: low}}"),
        f"8: {M}.tags.a.write: 'maybe': write true, false or {{min: 0, max: 100, verify: true}}",
        f"9: {M}.tags.b.write: min 5 is above max 1",
        f"10: {M}.tags.c.write.minimum: no setting of write: did you mean min?",
        f"11: {M}.tags.d.write: a bool has no min and max: only numbers have",
        f"12: {M}.tags.e.write.max: 70000 does not fit int16 (-32768 to 32767)",
        f"13: {M}.tags.f.write.min: 'low' is no number",
    ),
    bad(
        "write to an input",
        on_mixer("protocol: modbus-rtu\nstation: 3\ntags:\n"
                 "  a: {address: 'input:7', write: true}"),
        f"9: {M}.tags.a.write: input:7 is read-only: input cannot be written",
    ),
    bad(
        "tags that are not polled",
        on_mixer("protocol: modbus-rtu\nstation: 3\ntags:\n"
                 "  a: {address: 'holding:7', poll: false}\n"
                 "  b: {address: 'holding:7', poll: false, write: {verify: true}}\n"
                 "  c: {address: 'holding:8.3', poll: false, write: true}\n"
                 "  d: {address: 'holding:9', poll: false, write: true, alarm: {high: 3}}"),
        f"9: {M}.tags.a.poll: holding:7 is not written either: it needs write: true",
        f"10: {M}.tags.b.poll: holding:7 cannot be read back: remove verify",
        f"11: {M}.tags.c.poll: a write of holding:8 reads its word: write the whole word",
        f"12: {M}.tags.d.alarm: holding:9 can only be written: it can have no alarm",
    ),
    bad(
        "reading a broadcast",
        on_mixer("protocol: modbus-rtu\nstation: 0\ntags:\n"
                 "  a: {address: 'holding:7'}\n  b: {address: 'input:7'}\n"
                 "  c: {address: 'holding:8', write: {verify: true}}\n"
                 "  d: {address: 'holding:8.3', write: true}"),
        f"9: {M}.tags.a.write: holding:7 is never read at station 0: it needs write: true",
        f"10: {M}.tags.b.address: input:7 is read-only, and station 0 cannot be read",
        f"11: {M}.tags.c.write: holding:8 is never read at station 0: verify cannot work",
        f"12: {M}.tags.d.address: holding:8 is never read at station 0: write the whole word",
    ),
    bad(
        "tag names",
        tags("a b: {address: D1}", "/a: {address: D1}", "a//b: {address: D1}",
             '"a*": {address: D1}', '"@set": {address: D1}', '"": {address: D1}'),
        f"8: {M}.tags.a b: 'a b' has a space: names are letters and digits, `_`, `-`, `.`, `/`",
        f"9: {M}.tags./a: '/a': a `/` separates two parts of a name and cannot be at its end",
        f"10: {M}.tags.a//b: 'a//b': a `/` separates two parts of a name and cannot be at its end",
        f"11: {M}.tags.a*: 'a*' has '*': names are letters and digits, `_`, `-`, `.`, `/`",
        f"12: {M}.tags.@set: '@set' has '@': names are letters and digits, `_`, `-`, `.`, `/`",
        f"13: {M}.tags.: a name needs at least one character",
    ),
    bad(
        "long tag names",
        tags(f"{'a' * 200}: {{address: D1}}", f"{'水' * 67}: {{address: D2}}"),
        f"9: {M}.tags.{'水' * 67}: '{'水' * 67}' has 201 bytes in UTF-8, and a name at most 200: "
        "shorten it",
    ),
    bad(
        "duplicate tag",
        tags("a: {address: D1}", "b: {address: D2}", "a: {address: D3}"),
        f"8: {M}.tags.a: written twice, here and again in line 10: only one of them can be meant",
    ),
    bad(
        "duplicate setting",
        tags("a: {address: D1, address: D2}"),
        f"8: {M}.tags.a.address: written twice, here and again in one line: "
        "only one of them can be meant",
    ),
    bad(
        "no mapping",
        tags("a: D100", "b:"),
        f"8: {M}.tags.a: 'D100' stands where settings are expected, each as `name: value`",
        f"9: {M}.tags.b: nothing stands where settings are expected, each as `name: value`",
    ),
    bad(
        "all at once",
        on_mixer("protocol: vigor\nstation: 999\ntags:\n  a: {address: X8, evry: 1s}\n"
                 "  b: {address: M1, type: int16}"),
        f"7: {M}.station: station 999 is not 0..255",
        f"9: {M}.tags.a.evry: no setting of a tag: did you mean every?",
        f"9: {M}.tags.a.address: X8: X and Y are numbered in octal, 8 and 9 do not exist",
        f"10: {M}.tags.b.type: M1 is a bit: it can only be bool",
    ),
    bad(
        "a merge of no settings",
        tags("<<: 5", "a: &a {address: D1}", "b: {<<: [*a, 3]}", "c: {<<: , address: D2}"),
        f"7: {M}.tags: the `<<` in line 8 brings in no settings: write it as `<<: *name`",
        f"10: {M}.tags.b: the `<<` in line 10 brings in no settings: write it as `<<: *name`",
        f"11: {M}.tags.c: the `<<` in line 11 brings in no settings: write it as `<<: *name`",
    ),
    bad(
        "two merges in one mapping",
        tags("a: &a {address: D1}", "b: &b {address: D2}", "c:", "  <<: *a", "  <<: *b"),
        f"10: {M}.tags.c: `<<` is written twice, in lines 11 and 12: "
        "write one, `<<: [*first, *second]`",
    ),
    bad(
        "a mistake in what an anchor brings",
        "lines:\n  hall:\n    port: simulator\n    devices:\n"
        "      a: {protocol: vigor, station: 1, tags: &tags {t: {address: X9}}}\n"
        "      b: {protocol: vigor, station: 2, tags: {<<: *tags}}\n",
        "5: lines.hall.devices.a.tags.t.address: X9: X and Y are numbered in octal, "
        "8 and 9 do not exist",
        "5: lines.hall.devices.b.tags.t.address: X9: X and Y are numbered in octal, "
        "8 and 9 do not exist",
    ),
]  # fmt: skip


@pytest.mark.parametrize("case", [*UNREADABLE, *SECTIONS, *LINES, *DEVICES, *TAGS], ids=repr)
def test_a_mistake_is_reported_with_line_path_and_a_correct_example(
    case: Bad, file: Callable[[str | bytes], Config]
) -> None:
    with pytest.raises(ConfigErrors) as caught:
        file(case.text)
    assert caught.value.messages == tuple(f"plant.yaml:{message}" for message in case.says)
    assert str(caught.value) == "\n".join(caught.value.messages)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    missing = tmp_path / "plant.yaml"
    with pytest.raises(ConfigErrors) as caught:
        load(missing)
    assert str(caught.value) == f"{missing}: there is no such file"


def test_a_folder_is_no_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigErrors) as caught:
        load(tmp_path)
    assert str(caught.value) == f"{tmp_path}: this is a folder: name the file in it"


def test_a_path_through_a_file_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / "plant").write_text("")
    with pytest.raises(ConfigErrors) as caught:
        load(tmp_path / "plant" / "plant.yaml")
    assert str(caught.value).endswith("plant.yaml: cannot be read: Not a directory")


def test_the_file_of_the_contract(file: Callable[[str], Config], tmp_path: Path) -> None:
    config = file(CONTRACT)
    assert config.name == "demo"
    assert config.zenoh.prefix == "plant"
    assert config.zenoh.listen == ("tcp/127.0.0.1:7447",)
    history, web = config.part(HistorySection), config.part(WebSection)
    assert history is not None
    assert history.keep == 7 * 86400
    assert history.max_size == 10**9
    assert web is not None
    assert (web.host, web.port) == ("127.0.0.1", 8080)

    hall_1, hall_2 = config.lines
    assert hall_1.port == SerialPath("/dev/ttyUSB0")
    assert (hall_1.serial.baudrate, hall_1.serial.format) == (19200, "7E1")
    assert (hall_1.wire.baudrate, hall_1.wire.character_bits) == (19200, 10)
    assert hall_2.port == TcpAddress("10.0.0.7", 4001)
    assert hall_2.wire.character_bits == 11

    mixer, oven = hall_1.devices
    assert mixer.driver == Vigor(station=1)
    assert mixer.timing.reply_timeout == 0.5
    assert oven.driver == ComputerLink(station=5, frame_format=4, message_wait=0.02)
    assert [device.driver for device in hall_2.devices] == [
        ModbusRtu(station=3, addressing="k120s"),
        ModbusRtu(station=9),
    ]

    tag = {tag.name: tag for tag in mixer.tags}
    assert tag["speed"].key == "mixer/speed"
    assert tag["speed"].address == Address("D", 100)
    assert (tag["speed"].every, tag["speed"].publishing.deadband) == (0.5, Deadband(0.5))
    assert tag["level"].span == Span("D", 10, 2)
    assert tag["level"].every == 1.0
    assert str(tag["batches"].layout.type) == "int32"
    assert (tag["batches"].unit_kind, tag["batches"].span.size) == (Unit.DWORD, 1)
    assert tag["alarms/door"].label.description == "Guard door open"
    assert tag["valve"].address.bit == 3
    assert tag["valve"].decode([0b1000]) is True
    assert tag["name"].span.size == 8
    assert tag["recipe"].write == WriteRule(min=1, max=40, verify=True)
    assert tag["run"].write == WriteRule()
    assert tag["run"].span == Span("Y", 0o20, 1)
    run, number, power = hall_2.tags
    assert run.address == Address("M", 0x10)
    assert str(number.layout.type) == "uint16"
    assert power.layout.word_order is Order.HIGH_FIRST


def test_settings_left_out_are_the_defaults_of_the_protocol(file: Callable[[str], Config]) -> None:
    (line,) = file(tags("a: {address: D1}")).lines
    (device,) = line.devices
    assert (line.serial.baudrate, line.serial.format) == (19200, "7E1")
    assert line.port == SimulatorAddress()
    assert not line.echo
    assert device.timing == Vigor().timing
    assert device.turnaround is None
    assert device.late_guard == device.timing.reply_timeout
    assert device.enabled
    assert not device.blocks
    assert not device.control
    assert device.tags[0].publishing.publish is Publish.CHANGE
    assert device.tags[0].write is None


def test_device_settings_are_laid_over_the_protocols(file: Callable[[str], Config]) -> None:
    config = file(
        on_mixer(
            "protocol: vigor\nreply_timeout: 2s\nturnaround: 30ms\nsilence: 0ms\nretries: 0\n"
            "late_guard: 5s\nblocks: true\ncontrol: true\nenabled: false"
        )
    )
    (device,) = config.devices
    assert device.timing.reply_timeout == 2.0
    assert device.timing.turnaround == 0.03
    assert device.turnaround == 0.03
    assert device.timing.silence == 0.0
    assert not device.timing.learn_silence
    assert device.timing.retries == 0
    assert device.late_guard == 5.0
    assert (device.blocks, device.control, device.enabled) == (True, True, False)


def test_a_modbus_tcp_line_has_no_serial_line_unless_the_file_has_a_baudrate(
    file: Callable[[str], Config],
) -> None:
    rows = "port: tcp://[fe80::1]:502\ndevices: {m: {protocol: modbus-tcp, station: 1}}"
    (line,) = file(on_line(rows)).lines
    assert line.port == TcpAddress("fe80::1", 502)
    assert line.wire.baudrate == NETWORK_BAUD
    assert line.devices[0].driver == ModbusTcp(station=1)
    (line,) = file(on_line(rows + "\nbaudrate: 9600\nformat: 8N1")).lines
    assert line.wire.baudrate == 9600


def test_a_device_may_be_set_to_another_format_than_its_manual(
    file: Callable[[str], Config],
) -> None:
    rows = "port: /dev/ttyS0\ndevices: {m: {protocol: vigor, format: 8N1}}"
    for text in (rows, rows + "\nformat: 8N1"):
        (line,) = file(on_line(text)).lines
        assert (line.serial.format, line.devices[0].driver) == ("8N1", Vigor(format="8N1"))


def test_stations_of_two_protocols_may_have_one_number(file: Callable[[str], Config]) -> None:
    (line,) = file(
        on_line(
            "port: simulator\nbaudrate: 9600\nformat: 7E1\ndevices:\n"
            "  mixer: {protocol: vigor, station: 5}\n"
            "  oven: {protocol: modbus-ascii, station: 5}"
        )
    ).lines
    assert [device.driver.station for device in line.devices] == [5, 5]


def test_an_rfc2217_port(file: Callable[[str], Config]) -> None:
    (line,) = file(on_line("port: rfc2217://ds1:4001\ndevices: {m: {protocol: vigor}}")).lines
    assert line.port == Rfc2217Address("ds1", 4001)


def test_defaults_go_from_file_to_line_to_device_to_tag(file: Callable[[str], Config]) -> None:
    config = file(
        "defaults: {every: 4s, unit: a, offset: 1, heartbeat: 1min}\n"
        + on_line(
            """\
            port: simulator
            defaults: {every: 3s, unit: b, offset: 2}
            devices:
              mixer:
                protocol: vigor
                defaults: {every: 2s, unit: c}
                tags:
                  a: {address: D1, every: 1s}
                  b: {address: D2}
            """
        )
    )
    a, b = config.devices[0].tags
    assert [(t.every, t.label.unit, t.shaping.offset, t.publishing.heartbeat) for t in (a, b)] == [
        (1.0, "c", 2.0, 60.0),
        (2.0, "c", 2.0, 60.0),
    ]


def test_a_default_that_does_not_suit_a_tag_is_passed_over(file: Callable[[str], Config]) -> None:
    config = file(
        "defaults: {type: float32, scale: 2, deadband: 1%, write: {min: 0, max: 9}}\n"
        + on_mixer(
            "protocol: modbus-rtu\nstation: 1\ntags:\n"
            "  coil: {address: 'coil:1'}\n"
            "  input: {address: 'input:1'}\n"
            "  holding: {address: 'holding:1'}\n"
        )
    )
    coil, input_, holding = config.devices[0].tags
    assert coil.layout.type == ValueType(Kind.BOOL)
    assert (coil.shaping.scale, coil.publishing.deadband) == (1.0, None)
    assert coil.write == WriteRule()
    assert input_.write is None
    assert input_.layout.type == ValueType(Kind.FLOAT32)
    assert holding.write == WriteRule(min=0, max=9)
    assert holding.publishing.deadband == Deadband(1.0, percent=True)


def test_the_order_of_words_is_none_of_a_32_bit_counters(file: Callable[[str], Config]) -> None:
    rows = tags("a: {address: C200}", "b: {address: D1, type: int32}")
    counter, pair = file("defaults: {word_order: high_first}\n" + rows).devices[0].tags
    assert counter.decode([0x00012345]) == 0x00012345
    assert pair.decode([0x0001, 0x2345]) == 0x00012345


def test_a_default_can_be_taken_back(file: Callable[[str], Config]) -> None:
    tag = only_tag(file("defaults: {write: true}\n" + tags("a: {address: D1, write: false}")))
    assert tag.write is None


@pytest.mark.parametrize(
    ("protocol", "order"),
    [
        ("protocol: vigor", Order.LOW_FIRST),
        ("protocol: computer-link", Order.LOW_FIRST),
        ("protocol: modbus-rtu\nstation: 1\naddressing: k120s", Order.LOW_FIRST),
    ],
)
def test_plcs_keep_the_first_character_of_a_text_in_the_low_byte(
    protocol: str, order: Order, file: Callable[[str], Config]
) -> None:
    row = '\ntags:\n  a: {address: D1, type: "string[2]"}\n  b: {address: D1}'
    text, number = file(on_mixer(protocol + row)).devices[0].tags
    assert text.layout.byte_order is order
    assert number.layout.byte_order is Order.HIGH_FIRST


def test_plain_modbus_keeps_it_in_the_high_byte_and_the_file_has_the_last_word(
    file: Callable[[str], Config],
) -> None:
    rows = (
        "protocol: modbus-rtu\nstation: 1\ntags:\n"
        "  a: {address: 'holding:1', type: 'string[2]'}\n"
        "  b: {address: 'holding:1', type: 'string[2]', byte_order: low_first}"
    )
    a, b = file(on_mixer(rows)).devices[0].tags
    assert (a.decode([0x4142]), b.decode([0x4142])) == ("AB", "BA")


def test_yaml_surprises_are_none(file: Callable[[str], Config]) -> None:
    """`on` is a name, 010 is ten, 1e-3 a number, 7E1 and 1 texts where texts are meant."""
    config = file(
        on_line(
            """\
            port: simulator
            format: 7E1
            devices:
              on:
                protocol: vigor
                station: 010
                tags: {no: {address: D1, scale: 1e-3, unit: 1, description: 2026-01-01}}
            """
        )
    )
    (device,) = config.devices
    assert (device.name, device.driver.station, device.tags[0].name) == ("on", 10, "no")
    assert device.tags[0].shaping.scale == 0.001
    assert device.tags[0].label.unit == "1"
    assert device.tags[0].label.description == "2026-01-01"
    assert config.lines[0].serial.format == "7E1"


def test_modicon_numbers_keep_their_zeros(file: Callable[[str], Config]) -> None:
    rows = "protocol: modbus-rtu\nstation: 1\nnumbering: modicon\ntags: {a: {address: 00101}}"
    assert only_tag(file(on_mixer(rows))).address == Address("coil", 100)


def test_anchors_and_merges(file: Callable[[str], Config]) -> None:
    config = file(
        on_line(
            """\
            port: simulator
            devices:
              a: {protocol: vigor, station: 1, tags: &tags {x: {address: D1}, y: {address: D2}}}
              b: {protocol: vigor, station: 2, tags: {<<: *tags, y: {address: D3}}}
              c: {protocol: vigor, station: 3, tags: *tags}
            """
        )
    )
    texts = [{tag.name: tag.text for tag in device.tags} for device in config.devices]
    assert texts == [{"x": "D1", "y": "D2"}, {"x": "D1", "y": "D3"}, {"x": "D1", "y": "D2"}]


def test_names_of_any_script_and_a_byte_order_mark(file: Callable[[str], Config]) -> None:
    text = tags(
        "температура: {address: D1}", "mu\u0308hle/1.a-b_c: {address: D2}", "ไฟ: {address: M1}"
    )
    names = [tag.name for tag in file("\ufeff" + text).devices[0].tags]
    assert names == ["температура", "m\u00fchle/1.a-b_c", "ไฟ"]


def test_a_tag_may_be_the_branch_of_another(file: Callable[[str], Config]) -> None:
    config = file(tags("alarms: {address: D1}", "alarms/door: {address: M1}"))
    assert [tag.key for tag in config.devices[0].tags] == ["mixer/alarms", "mixer/alarms/door"]


def test_paths_are_relative_to_the_file(tmp_path: Path) -> None:
    (tmp_path / "zenoh.json5").write_text("{}")
    plant = tmp_path / "plant.yaml"
    plant.write_text(
        "zenoh: {config_file: zenoh.json5}\nhistory: {path: data/h.db}\n"
        + tags("a: {address: D1, history: true}")
    )
    config = load(plant)
    assert config.zenoh.config_file == tmp_path / "zenoh.json5"
    history = config.part(HistorySection)
    assert history is not None
    assert history.path == tmp_path / "data" / "h.db"
    assert only_tag(config).publishing.history


def test_loading_leaves_the_garbage_collector_as_it_was(file: Callable[[str], Config]) -> None:
    assert gc.isenabled()
    with pytest.raises(ConfigErrors):
        file("lines: {}")
    assert gc.isenabled()


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("500ms", 0.5), ("2s", 2.0), ("15min", 900.0), ("1h", 3600.0), ("7d", 604800.0),
     ("1.1s", 1.1), ("0.5 ms", 0.0005), ("100ms", 0.1), ("0s", 0.0)],
)  # fmt: skip
def test_durations(text: str, seconds: float) -> None:
    assert parsers.duration(text) == seconds


@pytest.mark.parametrize(
    "value", [True, None, [], "", "s", "1", "1 s s", "-1s", "1S", "١s", "1e3s", float("inf")]
)
def test_a_wrong_duration_is_refused(value: object) -> None:
    with pytest.raises(ConfigError):
        parsers.duration(value)


def test_sizes() -> None:
    assert [parsers.size(text) for text in ("1MB", "1.5GB", "2 TB")] == [
        10**6,
        1_500_000_000,
        2 * 10**12,
    ]
    with pytest.raises(ConfigError, match="too little"):
        parsers.size("10kB")


@given(st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8)
    | st.sampled_from(["simulator", "vigor", "D100", "M12", "500ms", "true", "7E1"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(
        st.sampled_from(["lines", "devices", "tags", "defaults", "a", "protocol", "station",
                         "address", "type", "every", "write", "min", "port", "zenoh", "listen",
                         "gateway", "name", "history", "web", "scale", "deadband"]),
        inner, max_size=5),
    max_leaves=20,
))  # fmt: skip
def test_any_file_is_loaded_or_its_mistakes_are_reported(data: Any) -> None:
    with tempfile.TemporaryDirectory() as folder:
        plant = Path(folder) / "plant.yaml"
        plant.write_text(json.dumps(data))
        told: tuple[str, ...] = (f"{plant}:",)
        try:
            load(plant)
        except ConfigErrors as error:
            told = error.messages
    assert told
    assert all(message.startswith(f"{plant}:") for message in told)


# ---- the example and the schema ----------------------------------------------------------


def test_the_example_loads_and_runs_without_hardware() -> None:
    config = load(EXAMPLE)
    assert config.name == "demo"
    assert all(line.port == SimulatorAddress() for line in config.lines)
    assert [device.driver.protocol for device in config.devices] == [
        "vigor",
        "computer-link",
        "modbus-rtu",
        "modbus-rtu",
        "modbus-tcp",
    ]
    assert all(device.enabled and device.tags for device in config.devices)
    assert EXAMPLE.read_text().startswith("# yaml-language-server: $schema=./config.schema.json\n")


def test_the_example_agrees_with_the_schema(tmp_path: Path) -> None:
    assert violations(plain(EXAMPLE), schema()) == []
    contract = tmp_path / "contract.yaml"
    contract.write_text(CONTRACT)
    assert violations(plain(contract), schema()) == []


def _settings_with_default(shape: Any, at: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    if isinstance(shape, dict):
        for name, setting in shape.get("properties", {}).items():
            if "default" in setting:
                yield f"{at}/{name}", setting
        for name, inner in shape.items():
            yield from _settings_with_default(inner, f"{at}/{name}")


def test_every_default_in_the_schema_is_one_that_the_file_could_say() -> None:
    root = schema()
    found = dict(_settings_with_default(root))
    assert len(found) > 50
    for where, setting in found.items():
        assert violations(setting["default"], setting | {"$defs": root["$defs"]}) == [], where


@pytest.mark.parametrize(
    ("section", "settings"),
    [
        (HistorySection, ("path", "keep", "max_size")),
        (WebSection, ("listen",)),
        (ZenohSection, ("prefix", "mode", "listen", "connect")),
        (TagDefaults, ("every", "scale", "publish", "payload")),
    ],
)
def test_a_default_in_the_schema_equals_the_setting_left_out(
    section: type[Section], settings: tuple[str, ...]
) -> None:
    name_there = "Defaults" if section is TagDefaults else section.__name__
    shape = schema()["$defs"][name_there]["properties"]
    said = section.model_validate({name: shape[name]["default"] for name in settings})
    unsaid = section.model_validate({})
    for name in settings:
        assert getattr(said, name) == getattr(unsaid, name), name


@pytest.mark.parametrize(
    ("case", "where"),
    [
        (tags("a: {adress: D1}"), "/lines/hall/devices/mixer/tags/a"),
        (tags("a: {address: D1, every: 5}"), "/lines/hall/devices/mixer/tags/a/every"),
        (tags("a: {address: D1, write: {minimum: 5}}"), "/lines/hall/devices/mixer/tags/a/write"),
        (on_mixer("protocol: vigor\nframe_format: 4"), "/lines/hall/devices/mixer"),
        (on_mixer("protocol: vigr"), "/lines/hall/devices/mixer/protocol"),
        (on_mixer("station: 1"), "/lines/hall/devices/mixer"),
        (on_line("devices: {a: {protocol: vigor}}"), "/lines/hall"),
        ("lines: {}\nzeno: 1\n", ""),
    ],
)
def test_the_schema_finds_the_mistakes_that_an_editor_can_find(
    case: str, where: str, tmp_path: Path
) -> None:
    plant = tmp_path / "plant.yaml"
    plant.write_text(case)
    assert where in violations(plain(plant), schema())


def _station(protocol: str, number: int) -> str:
    return on_line(f"port: tcp://a:1\ndevices: {{m: {{protocol: {protocol}, station: {number}}}}}")


def _port(text: str) -> str:
    return on_line(f"port: {text}\ndevices: {{m: {{protocol: vigor}}}}")


def _zenoh(setting: str) -> str:
    return f"zenoh: {{{setting}}}\n" + tags("a: {address: D1}")


@pytest.mark.parametrize(
    "text",
    [
        *(tags(f"a: {{address: D1, {setting}}}") for setting in (
            "scale: 0", "scale: 0.0", "every: 0s", "every: 0.0ms", "heartbeat: 0min",
            'type: "string[0]"', 'type: "string[251]"', 'type: "string[00]"',
        )),
        *(_station(*station) for station in (
            ("vigor", -1), ("vigor", 256), ("computer-link", 32), ("modbus-rtu", 248),
            ("modbus-ascii", 248), ("modbus-tcp", 256), ("modbus-tcp", 999),
        )),
        *(_port(f"/dev/ttyS3\nbaudrate: {rate}") for rate in (0, -9600, 9601)),
        *(_port(port) for port in (
            "tcp://", "tcp://10.0.0.7", "'tcp://10.0.0.7:'", "rfc2217://a", "http://a:1", "4001",
            "10.0.0.7:4001", "http://a:1", '" COM3"', '""',
        )),
        *(_zenoh(setting) for setting in (
            "listen: [127.0.0.1:7447]", "connect: [tcp]", 'listen: [""]', "prefix: plant/**",
            'prefix: "@plant"', "prefix: plant/", "prefix: a//b", 'prefix: ""', "user: 5",
        )),
        "gateway: {name: my gateway}\n" + tags("a: {address: D1}"),
        "gateway: {standby: 5}\n" + tags("a: {address: D1}"),
        "gateway: {standby: a/b}\n" + tags("a: {address: D1}"),
        "web: {listen: 127.0.0.1}\n" + tags("a: {address: D1}"),
        *(on_line(f"port: /dev/ttyS3\ndevices: {{{name}: {{protocol: vigor}}}}") for name in (
            '"a b"', "a/b", '"@a"', '"a*"', '""',
        )),
        "lines: {a/b: {port: /dev/ttyS3, devices: {m: {protocol: vigor}}}}\n",
        *(tags(f"{name}: {{address: D1}}") for name in (
            '"a b"', "a//b", "/a", "a/", '"@set"', '"a$"', '"a?"', '"a#b"', '""',
        )),
    ],
)  # fmt: skip
def test_an_editor_shows_the_settings_that_the_program_refuses(
    text: str, file: Callable[[str | bytes], Config], tmp_path: Path
) -> None:
    with pytest.raises(ConfigErrors):
        file(text)
    assert violations(plain(tmp_path / "plant.yaml"), schema())


@pytest.mark.parametrize(
    "text",
    [
        *(tags(f"a: {{address: D1, {setting}}}") for setting in (
            "unit: true", "unit: 1", "description: 3.5", "every: 0.5s", "every: 10ms",
            "every: 1 h", "scale: -0.5", 'type: "string[1]"', 'type: "string[128]"',
            'type: "string[016]"', "unit: °C",
        )),
        *(_station(*station) for station in (
            ("vigor", 0), ("vigor", 255), ("computer-link", 31), ("modbus-rtu", 0),
            ("modbus-rtu", 247), ("modbus-tcp", 255),
        )),
        *(_port(port) for port in (
            "/dev/serial/by-path/pci-0000:00:14.0-usb-0:2:1.0-port0", "/dev/my port",
            "tcp://10.0.0.7:4001", "tcp://[fe80::1]:502", "rfc2217://ds-1.plant:4001",
            "simulator", "/dev/ttyS3\nbaudrate: 115200",
        )),
        *(_zenoh(setting) for setting in (
            "listen: [tcp/127.0.0.1:7447, 'tls/[::]:7447#a=b']", "prefix: plant/site-1",
            "prefix: 7", "prefix: ไฟ/été", "user: gateway", "user: null",
        )),
        "gateway: {name: 7, standby: hall}\n" + tags("a: {address: D1}"),
        "web: {listen: '[::1]:8080'}\n" + tags("a: {address: D1}"),
        tags("температура: {address: D1}", "mühle/1.a-b_c: {address: D2}", "ไฟ: {address: M1}"),
    ],
)  # fmt: skip
def test_an_editor_accepts_the_settings_that_the_program_accepts(
    text: str, file: Callable[[str | bytes], Config], tmp_path: Path
) -> None:
    assert file(text).lines
    assert violations(as_editors_see_it(tmp_path / "plant.yaml"), schema()) == []


def test_the_schema_offers_the_settings_of_each_protocol_alone() -> None:
    shapes = schema()["$defs"]
    assert {"protocol", "station", "tags", "retries"} <= shapes["vigor"]["properties"].keys()
    assert "frame_format" not in shapes["vigor"]["properties"]
    assert shapes["computer-link"]["properties"]["frame_format"]["enum"] == [1, 4]
    assert "ms" in shapes["computer-link"]["properties"]["message_wait"]["pattern"]
    assert "_master" not in shapes["modbus-rtu"]["properties"]


def as_editors_see_it(path: Path) -> Any:
    """`unit: true` is no text to them."""
    return read_yaml(path, frozenset())[0].data


def plain(path: Path) -> Any:
    return read_yaml(path, frozenset({"format", "address"}))[0].data


# -- who may connect, read and write -----------------------------------------------------------


def test_security_settings_are_files_beside_the_configuration(
    file: Callable[[str | bytes], Config],
) -> None:
    for name in ("ca.pem", "gw.pem", "gw.key", "password", "users", "writers"):
        Path(name).touch()
    config = file(
        "gateway: {name: left, standby: hall, standby_alone: 1min, secret_file: password}\n"
        "writers: {file: writers}\n"
        "zenoh:\n"
        "  tls: {ca: ca.pem, certificate: gw.pem, key: gw.key, mutual: true}\n"
        "  user: gateway\n"
        "  password_file: password\n"
        "  users_file: users\n" + tags("speed: {address: D1}")
    )
    zenoh = config.zenoh
    assert zenoh.tls is not None
    assert (zenoh.tls.ca, zenoh.tls.certificate, zenoh.tls.key, zenoh.tls.mutual) == (
        Path("ca.pem"),
        Path("gw.pem"),
        Path("gw.key"),
        True,
    )
    assert (zenoh.user, zenoh.password_file, zenoh.users_file) == (
        "gateway",
        Path("password"),
        Path("users"),
    )
    assert (config.standby, config.standby_alone) == ("hall", 60.0)
    assert config.secret_file == Path("password")
    assert config.writers_file == Path("writers")


def test_without_security_settings_there_are_none(file: Callable[[str | bytes], Config]) -> None:
    config = file(tags("speed: {address: D1}"))
    assert (config.zenoh.tls, config.zenoh.user, config.zenoh.users_file) == (None, None, None)
    assert (config.standby, config.writers_file) == (None, None)


def test_payload_is_json_unless_tag_device_line_or_file_sets_raw(
    file: Callable[[str | bytes], Config],
) -> None:
    config = file(
        "defaults: {payload: raw}\n"
        + tags("speed: {address: D1}", "level: {address: D2, payload: json}")
    )
    assert {tag.name: tag.publishing.payload for tag in config.devices[0].tags} == {
        "speed": Form.RAW,
        "level": Form.JSON,
    }
    assert only_tag(file(tags("speed: {address: D1}"))).publishing.payload is Form.JSON


@pytest.mark.parametrize(
    ("rows", "says"),
    [
        ("zenoh: {tls: {certificate: a.pem}}", "certificate and key belong together"),
        ("zenoh: {tls: {mutual: true}}", "mutual needs ca, certificate and key"),
        ("zenoh: {password_file: p}", "password_file has no effect without user"),
        ("zenoh: {users_file: nowhere}", "1: zenoh.users_file: there is no file nowhere"),
        ("zenoh: {tls: {ca: nowhere}}", "1: zenoh.tls.ca: there is no file nowhere"),
        ("zenoh: {password: x}", "1: zenoh.password: no setting of zenoh"),
        ("writers: {file: nowhere}", "1: writers.file: there is no file nowhere"),
        ("writers: {}", "1: writers.file: missing"),
        ("gateway: {standby_alone: 1min}", "standby_alone has no effect without standby"),
        ("gateway: {secret_file: nowhere}", "1: gateway.secret_file: there is no file nowhere"),
        ("gateway: {standby: a/b}", "1: gateway.standby: 'a/b' has a `/`"),
        ("defaults: {payload: xml}", "1: defaults.payload: 'xml' is not known: use json or raw"),
    ],
)
def test_a_mistake_in_these_settings_is_reported_with_its_place(
    file: Callable[[str | bytes], Config], rows: str, says: str
) -> None:
    with pytest.raises(ConfigErrors) as raised:
        file(f"{rows}\n" + tags("speed: {address: D1}"))
    assert any(says in message for message in raised.value.messages), raised.value.messages
