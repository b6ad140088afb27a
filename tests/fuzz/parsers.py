"""Every parser of what others send, or leave on the disk: any bytes give a result or its errors.

Each function takes bytes, allows only the errors that its parser promises, and uses the result as
the gateway does.
"""

import asyncio
import math
import tempfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path

from gateway.config.sheets.grid import read_grid
from gateway.contract import payload
from gateway.contract.access import certificates, signatures
from gateway.contract.access.writers import Writers
from gateway.contract.keys import Keys, max_age, parse_key, part_of
from gateway.contract.parsing import check_encoding, parse_group, parse_write
from gateway.contract.past.history_query import question
from gateway.contract.past.timerange import EARLIEST, LATEST, time_range
from gateway.errors import BadValue, Busy, ConfigError, NotAllowed, Repeated
from gateway.line.send_permit import SendPermit
from gateway.northbound.answering.pages import recorded_place
from gateway.northbound.group.claim_documents import ClaimDocuments
from gateway.northbound.group.plant_secret import PlantSecret
from gateway.northbound.group.standby import GroupTokens
from gateway.northbound.requests.acceptance import Acceptance, AcceptedUntil, Sender
from gateway.parts.alarms import file as alarm_file
from gateway.parts.alarms.orders import parse_order
from gateway.parts.audit.file import Event, checked, lines, link, within
from gateway.parts.history.files import aside
from gateway.parts.recording.wire_file import entries
from gateway.parts.serving import served_lines
from gateway.parts.state.part import StateFile
from gateway.plant.saved_file import SavedFile
from tests.history_writer import tag

KEY, CLAIM = "plant/mixer/speed/@set", "plant/@gateway/other/claim/f00d"
ALICE, SECRET = "alice", "a" * 40
SPEED = tag("speed")
NOW = 1_795_262_400 * 10**9
KEYS, OTHERS = Keys("plant", "demo"), PlantSecret("p" * 40)
LOOP = asyncio.new_event_loop()


@cache
def folder() -> Path:
    made = Path(tempfile.mkdtemp(prefix="fuzz"))
    (made / "writers.txt").write_text(f"{ALICE}:{SECRET}\n")
    (made / "writers.txt").chmod(0o600)
    return made


def file(data: bytes) -> Path:
    path = folder() / "any"
    path.write_bytes(data)
    return path


@cache
def writers() -> Writers:
    return Writers(folder() / "writers.txt", wall=lambda: NOW, clock=lambda: NOW / 1e9)


def text(data: bytes) -> str:
    return data.decode(errors="replace")


def write(data: bytes) -> None:
    with suppress(BadValue):
        found = parse_write(data)
        assert isinstance(found, bool | int | float | str | tuple)
        assert not isinstance(found, float) or math.isfinite(found)


def group(data: bytes) -> None:
    with suppress(BadValue):
        assert all(isinstance(name, str) for name, _ in parse_group(data))


def signature(data: bytes) -> None:
    with suppress(NotAllowed, Repeated):
        writers().writer(KEY, data, data)
    if (signed := signatures.parse(data)) is not None:
        own = signatures.sign(ALICE, SECRET, signed.time, KEY, data)
        with suppress(NotAllowed, Repeated):
            assert writers().writer(KEY, data, own) == ALICE


def attachment(data: bytes) -> None:
    async def accepted() -> None:
        now = asyncio.get_running_loop().time()
        sender = Sender(None, data, now)
        with suppress(Busy):
            assert (
                0
                < Acceptance(SendPermit(), None, lambda: NOW).accept(KEY, data, sender).within
                <= 5
            )

    LOOP.run_until_complete(accepted())


def encoding(data: bytes) -> None:
    with suppress(BadValue):
        check_encoding(text(data))


def claim(data: bytes) -> None:
    for secret in (None, OTHERS):
        claims = ClaimDocuments(KEYS, secret)
        if (found := claims.parse(CLAIM, data, 0.0)) is not None:
            payload.document(claims.document(found, {}))


def token(data: bytes) -> None:
    for secret in (None, OTHERS):
        tokens = GroupTokens(KEYS, "hall", secret)
        if (found := tokens.parse(f"{tokens.all[:-2]}{text(data)}", 0.0)) is not None:
            assert tokens.key(found)


def acknowledgement(data: bytes) -> None:
    with suppress(BadValue):
        order = parse_order(data, 3600.0)
        assert order.by.isprintable()
        assert 0 <= order.seconds <= 3600


def key(data: bytes) -> None:
    parse_key(text(data))
    part_of(text(data))


def selector(data: bytes) -> None:
    asked = text(data)
    with suppress(BadValue):
        question(dict(part.partition("=")[::2] for part in asked.split(";")))
    with suppress(BadValue):
        found = time_range(asked, NOW)
        assert EARLIEST <= found.first <= LATEST
        assert EARLIEST <= found.last <= LATEST
    with suppress(BadValue):
        assert max_age(asked) >= 0
    with suppress(BadValue):
        recorded_place(asked)


def alarms_file(data: bytes) -> None:
    if (found := SavedFile(file(data)).load(alarm_file.parse)) is not None:
        alarm_file.snapshot(found)


def state_file(data: bytes) -> None:
    state = StateFile(file(data))
    _, counters = state.load()
    state.snapshot((), counters)


def accepted_file(data: bytes) -> None:
    assert 0 <= AcceptedUntil(file(data)).floor < 2**36


def held_file(data: bytes) -> None:
    if (found := SavedFile(file(data)).load(served_lines.parser((SPEED,)))) is not None:
        assert served_lines.to_text(found)


def audit_file(data: bytes) -> None:
    found = data.split(b"\n")
    assert len([*checked(found)]) == len(found)
    for number, _ in within(found, time_range("[2026-11-21T12:00:00Z..]", NOW)):
        assert number >= 0
    lines(link(found[-1]), [Event(NOW, "{}")])


def history_file(data: bytes) -> None:
    for rows in aside.rows(file(data)):
        assert all(isinstance(row[0], str) for row in rows)


def wire_log(data: bytes) -> None:
    for _ in entries(text(data).splitlines()):
        pass


def certificate(data: bytes) -> None:
    with suppress(ConfigError):
        assert math.isfinite(certificates.expires(data))


def sheet(data: bytes) -> None:
    with suppress(ConfigError):
        read_grid(data)


PARSERS: Mapping[str, Callable[[bytes], None]] = {
    one.__name__: one
    for one in (
        *(write, group, signature, attachment, encoding, claim, token, acknowledgement, key),
        *(selector, alarms_file, state_file, accepted_file, held_file, audit_file, history_file),
        *(wire_log, certificate, sheet),
    )
}
# What the fuzzer begins with, and every test run tries, beside the corpus.
SEEDS: Mapping[str, tuple[bytes, ...]] = {
    "write": (b"12.5", b'{"value": [1, true, "x"]}', b"-1e309", b"NaN", b'"\\ud800"', b"[" * 5000),
    "group": (b'{"recipe/a": 1, "recipe/b": {"value": 2}}', b'{"a": 1, "a": 2}', b"[" * 5000),
    "signature": (
        b'{"by":"alice","time":"2026-11-21T12:00:00Z","nonce":"0123456789abcdef","signature":"00"}',
        (
            b'{"by":"alice","time":"0001-01-01T00:00:00+23:59","nonce":"0123456789abcdef",'
            b'"signature":"00"}'
        ),
    ),
    "attachment": (b'{"time": "2026-11-21T12:00:00Z"}', b'{"time": "0001-01-01"}', b"{}"),
    "encoding": (b"application/json", b"application/cbor", b"zenoh/int8", b"text/plain;x"),
    "claim": (
        b'{"ticket": 7, "group": null, "devices": ["mixer"]}',
        b'{"ticket": 18446744073709551615, "group": "hall", "devices": []}',
        b'{"ticket": 1, "group": "hall", "devices": ["a"], "signature": "00"}',
    ),
    "token": (b"active/a/f00d", b"standby/a/f00d/0011", b"active/a/b/c/d"),
    "acknowledgement": (b'{"by": "Ana"}', b'{"by": "\\r\\n", "raised": 7}', b'{"by": "\\ud800"}'),
    "key": (b"plant/mixer/speed/@set", b"plant/@gateway/demo/lines/hall/global", b"a/@adv/b"),
    "selector": (
        *(b"_time=[now(-1h)..];bucket=1min;agg=min,max", b"[now(-1h)..now()]", b"500ms"),
        *(b"]2026-11-21T12:00:00.5+01:00..9999-12-31T23:59:59Z[", b"0a1f-3-17", b"last=5;limit=1"),
    ),
    "alarms_file": (
        (
            b'{"form":1,"alarms":{"mixer/speed":{"state":"acknowledged","level":"high","since":1,'
            b'"raised":1,"value":1e308,"acknowledged":{"by":"Ana","time":1,"via":null}}}}'
        ),
    ),
    "state_file": (
        (
            b'{"form":1,"devices":{"mixer":{"refused":[{"area":"D","start":1,"size":2,"since":3,'
            b'"code":"06"}],"cuts":[["D",7]]}},"counters":{"mixer/n":[1,2]}}'
        ),
        b'{"form":1,"devices":{},"counters":{"mixer/n":[1,1e300]}}',
    ),
    "accepted_file": (b'{"accepted_until": 1795262400.5}', b'{"accepted_until": 1e300}'),
    "held_file": (b'{"form": 1, "held": {"mixer/speed": [1, 2.5]}}', b"[" * 100_000),
    "audit_file": (
        lines(link(b""), [Event(NOW, '{"value":1}'), Event(NOW, "{}")])[0],
        b'{"n":1e999,"time":1,"before":[],"event":null}',
    ),
    "history_file": (b"SQLite format 3\0" + bytes(4080), b"\x0d" + bytes(4095)),
    "wire_log": (b"1763640000.1 > 02 30 31\n1763640000.2 = mixer/speed [12.5]\n# note",),
    "certificate": (b"-----BEGIN CERTIFICATE-----\nMIIB\n-----END CERTIFICATE-----\n",),
    "sheet": (b"name;address;every\nspeed;D100;1s\n", b'a,"b\n', b"PK\x03\x04", b"\xff\xfea\0;\0"),
}
assert SEEDS.keys() == PARSERS.keys()
