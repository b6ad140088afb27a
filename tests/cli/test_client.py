"""The client of a gateway: its arguments, its connection, and the replies it accepts."""

import json
import signal
import socket
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
import zenoh

from gateway.cli.client import Client, TagRow, connected, parse_value, value_pages, wanted_keys
from gateway.config import Config, load
from gateway.errors import ConfigError, GatewayError
from gateway.values import Value
from tests.e2e.processes import gateway, vigor_line, write_config
from tests.zenoh_peer import free_endpoint

TIME = "2026-11-20T12:00:00.123456Z"
Answer = Callable[[zenoh.Query], None]
Request = Callable[[Client], object]
META = "plant/mixer/**/@meta"
REQUESTS: list[Request] = [
    lambda client: client.requests.write("mixer/speed", 5),
    lambda client: client.requests.control("hall", "mixer", "stop", ""),
]


@pytest.fixture
def config(tmp_path: Path) -> Config:
    tags = {
        "speed": {"address": "D10"},
        "alarms/door": {"address": "M12"},
        "label": {"address": "D20", "type": "string[8]", "payload": "raw"},
        "count": {"address": "D30", "payload": "raw"},
    }
    lines = {"hall": vigor_line("simulator", tags)}
    return load(write_config(tmp_path / "config.yaml", free_endpoint(), lines))


@pytest.mark.parametrize(
    ("typed", "value"),
    [
        ("12", 12),
        ("-3.5", -3.5),
        ("true", True),
        ('"12"', "12"),
        ("AB", "AB"),
        ("", ""),
        ("[1]", (1,)),
        ("[true, 1.5]", (True, 1.5)),
        ("[]", ()),
        ("[[1]]", "[[1]]"),
        ("[1, NaN]", "[1, NaN]"),
        ("[AB]", "[AB]"),
        ("null", "null"),
        ('{"value": 1}', '{"value": 1}'),
        ("NaN", "NaN"),
        ("-Infinity", "-Infinity"),
        ("1e999", "1e999"),
        ("9" * 5000, "9" * 5000),
    ],
)
def test_a_value_argument_is_a_json_scalar_or_text(typed: str, value: object) -> None:
    parsed = parse_value(typed)
    assert parsed == value
    assert type(parsed) is type(value)


@pytest.mark.parametrize(
    ("names", "keys"),
    [
        (None, ["**"]),
        ([], ["**"]),
        (["mixer"], ["mixer/**"]),
        (["mixer/speed"], ["mixer/speed"]),
        (["mixer/alarms/door", "mixer/*"], ["mixer/alarms/door", "mixer/*"]),
        (["**/door"], ["**/door"]),
    ],
)
def test_names_become_key_expressions(
    config: Config, names: list[str] | None, keys: list[str]
) -> None:
    assert wanted_keys(config, names) == keys


@pytest.mark.parametrize(
    "name", ["mixer/sped", "oven", "*/sped", "", "/", "mixer/", "mixer//speed", "a?b", "a#b", "***"]
)
def test_names_that_match_no_tag_are_refused(config: Config, name: str) -> None:
    with pytest.raises(ConfigError):
        wanted_keys(config, ["mixer/speed", name])


def test_a_configuration_without_endpoints_has_no_gateway(config: Config) -> None:
    nowhere = replace(config, zenoh=replace(config.zenoh, listen=(), connect=()))
    with pytest.raises(GatewayError, match="no gateway can be reached"), connected(nowhere, print):
        pass


def test_in_a_standby_group_the_client_tries_the_other_endpoints_first(
    config: Config,
) -> None:
    """A standby gateway answers no queries at its own endpoint."""
    here, there = free_endpoint(), free_endpoint()
    own = replace(config.zenoh, listen=(here,), connect=(there,))
    group = replace(config, zenoh=own, standby="hall")
    at_the_router = replace(config, zenoh=replace(own, listen=(there,)))
    rows = saying(("mixer/speed", good(1), None))
    with (
        answering(replace(config, zenoh=own), {}),
        answering(at_the_router, {"plant/**": rows}),
        connected(group, print) as client,
    ):
        assert rows_of(client, "**") == [("mixer/speed", 1)]


def test_the_client_of_a_standby_whose_partner_is_dead_reaches_it(config: Config) -> None:
    """Neither a closed port nor one that never answers takes the time of the others."""
    here, closed = free_endpoint(), free_endpoint()
    with socket.create_server(("127.0.0.1", 0)) as silent:
        mute = f"tcp/127.0.0.1:{silent.getsockname()[1]}"
        own = replace(config.zenoh, listen=(here,), connect=(closed, mute))
        standby = replace(config, zenoh=own, standby="hall")
        failed = pytest.raises(GatewayError, match=f"^{mute} takes connections and does not answer")
        with failed, connected(standby, print):
            pass
        row = ("mixer/speed", good(1), None)
        with (
            answering(replace(config, zenoh=own), {"plant/**": saying(row)}),
            connected(standby, print) as client,
        ):
            assert rows_of(client, "**") == [("mixer/speed", 1)]


def test_a_wrong_password_beside_a_dead_partner_is_said(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, closed = free_endpoint(), free_endpoint()
    users = tmp_path / "users.txt"
    users.write_text("operator:right\n")
    own = replace(config.zenoh, listen=(here,), connect=(closed,))
    standby = replace(config, zenoh=own, standby="hall")
    monkeypatch.setenv("PLC_GATEWAY_CLI_USER", "operator")
    monkeypatch.setenv("PLC_GATEWAY_CLI_PASSWORD", "wrong")
    refused = pytest.raises(GatewayError, match=f"^{here} refuses the user operator: the name or")
    of_gateway = {"user": "demo", "password": "own", "dictionary_file": str(users)}
    with answering(replace(config, zenoh=own), {}, **of_gateway):
        with refused, connected(standby, print):
            pass
        monkeypatch.setenv("PLC_GATEWAY_CLI_PASSWORD", "right")
        with connected(standby, print):
            pass


# -- with a Zenoh session in place of the gateway ----------------------------------------------


@contextmanager
def answering(
    config: Config, answers: Mapping[str, Answer], **more: object
) -> Iterator[zenoh.Session]:
    """A Zenoh session at the gateway's endpoint with these queryables. `more`: of its users."""
    setup = zenoh.Config()
    settings = {
        "mode": "peer",
        "listen/endpoints": list(config.zenoh.listen),
        "scouting/multicast/enabled": False,
        # Microseconds: Zenoh drops a put after 1 ms on a full link. A busy machine needs longer.
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 10_000_000,
        **{f"transport/auth/usrpwd/{name}": value for name, value in more.items()},
    }
    for path, value in settings.items():
        setup.insert_json5(path, json.dumps(value))
    with zenoh.open(setup) as session:
        declared = [session.declare_queryable(key, answer) for key, answer in answers.items()]
        yield session
        declared.clear()


def described(query: zenoh.Query) -> None:
    """Replies as the gateway of the device."""
    with query:
        query.reply("plant/mixer/speed/@meta", b"{}")


def saying(
    *rows: tuple[str, bytes, Mapping[str, object] | None], by: str = "demo", lost: int = 0
) -> Answer:
    """Replies with the matching rows: tag, payload, and the attachment of a raw value.

    It replies in pages, as the gateway `by`. `lost`: rows that do not arrive.
    """

    def answer(query: zenoh.Query) -> None:
        with query:
            found = [row for row in rows if query.key_expr.intersects(f"plant/{row[0]}")]
            size, after = query.parameters.get("page"), query.parameters.get("after") or ""
            places = dict(place.partition(":")[::2] for place in after.split(","))
            first = int(places.get(by, 0))
            page = found[first:][: None if size is None else int(size)]
            for tag, data, about in page[lost:]:
                attachment = None if about is None else json.dumps(about)
                query.reply(f"plant/{tag}", data, attachment=attachment)
            if size is not None and page:
                end = first + len(page)
                complete, place = end == len(found), f"{by}:{end}"
                document = {"samples": len(page), "complete": complete, "next": place}
                query.reply(f"plant/@gateway/{by}/page", json.dumps(document))

    return answer


def good(value: object) -> bytes:
    return json.dumps({"value": value, "quality": "good", "time": TIME}).encode()


def rows_of(client: Client, wanted: str) -> list[tuple[str, object]]:
    return [(row.tag, row.document["value"]) for row in client.values(wanted)]


@pytest.mark.parametrize("text", ["12.50", "1e5", "true", " 7", "AB", ""])
def test_a_raw_text_is_shown_unchanged(config: Config, text: str) -> None:
    known = {"quality": "good", "time": TIME}
    rows = ("mixer/label", text.encode(), known), ("mixer/count", b"7", known)
    with answering(config, {"plant/**": saying(*rows)}), connected(config, print) as client:
        assert rows_of(client, "mixer/*") == [("mixer/count", 7), ("mixer/label", text)]


def test_two_gateways_for_one_device_are_reported_once_and_sorted_by_tag(config: Config) -> None:
    first = saying(("mixer/speed", good(1), None), ("mixer/alarms/door", good(True), None))
    both = ("mixer/speed", good(2), None), ("mixer/alarms/door", good(False), None)
    other = saying(*both, by="other")
    told: list[str] = []
    with (
        answering(config, {"plant/**": first, "plant/mixer/**": other}),
        connected(config, told.append) as client,
    ):
        rows = rows_of(client, "**")
        client.values("mixer/speed")
    assert [tag for tag, _ in rows] == ["mixer/alarms/door"] * 2 + ["mixer/speed"] * 2
    assert {value for tag, value in rows if tag == "mixer/speed"} == {1, 2}
    assert told == ["more than one gateway replies for mixer: their values may differ"]


def test_the_pages_of_two_gateways_arrive_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(value_pages, "FIRST", 2)
    monkeypatch.setattr(value_pages, "PAGE_WITHIN", 0.0)  # so that each later page has one value
    lines = {"hall": vigor_line("simulator", {f"d{i}": {"address": f"D{i}"} for i in range(9)})}
    many = load(write_config(tmp_path / "many.yaml", free_endpoint(), lines))
    left, right = (
        saying(*((f"mixer/d{i}", good(i), None) for i in numbers), by=by)
        for by, numbers in (("left", range(3)), ("right", range(3, 9)))
    )
    with (
        answering(many, {"plant/**": left, "plant/mixer/**": right}),
        connected(many, print) as client,
    ):
        assert rows_of(client, "**") == [(f"mixer/d{i}", i) for i in range(9)]


def test_values_that_did_not_arrive_are_an_error(config: Config) -> None:
    rows = [(f"mixer/{tag}", good(1), None) for tag in ("speed", "count")]

    def without_end(query: zenoh.Query) -> None:
        with query:
            query.reply("plant/mixer/speed", good(1))

    for cut in (saying(*rows, lost=1), saying(*rows, lost=2), without_end):
        with (
            answering(config, {"plant/**": cut}),
            connected(config, print) as client,
            pytest.raises(GatewayError, match="not all values have arrived"),
        ):
            client.values("**")


def test_tags_outside_the_file_are_left_out(config: Config) -> None:
    rows = ("press/speed", good(1), None), ("mixer/speed", good(2), None)
    with (
        answering(config, {"plant/**": saying(*rows)}) as there,
        connected(config, print) as client,
        closing(client.follow(["**"])) as news,
    ):
        assert rows_of(client, "**") == [("mixer/speed", 2)]
        assert next(news).tag == "mixer/speed"
        there.put("plant/press/speed", good(3))
        there.put("plant/mixer/speed", good(4))
        assert next(news) == ("mixer/speed", json.loads(good(4)))


def shown_as(news: Iterator[TagRow]) -> object:
    document = next(news).document
    return document.get("reason") or document["value"]


def test_a_late_value_of_a_lost_gateway_is_not_shown(config: Config) -> None:
    answer = saying(("mixer/speed", good(1), None))
    with (
        answering(config, {}) as there,
        connected(config, print) as client,
        closing(client.follow(["**"])) as news,
    ):
        served = there.declare_queryable("plant/**", answer)
        token = there.liveliness().declare_token("plant/@gateway/demo")
        assert shown_as(news) == 1
        served.undeclare()  # type: ignore[no-untyped-call]  # Zenoh's stub lacks it
        token.undeclare()  # type: ignore[no-untyped-call]  # Zenoh's stub lacks it
        assert shown_as(news) == "no-gateway"
        there.put("plant/mixer/speed", good(2))
        served = there.declare_queryable("plant/**", saying(("mixer/speed", good(3), None)))
        token = there.liveliness().declare_token("plant/@gateway/demo")
        assert shown_as(news) == 3


def test_the_values_of_a_device_that_went_offline_are_queried(config: Config) -> None:
    """Whatever was published of it may be lost on the way."""
    with (
        answering(config, {}) as there,
        connected(config, print) as client,
        closing(client.follow(["**"])) as news,
    ):
        served = there.declare_queryable("plant/**", saying(("mixer/speed", good(1), None)))
        token = there.liveliness().declare_token("plant/@gateway/demo/alive/mixer")
        assert shown_as(news) == 1
        served.undeclare()  # type: ignore[no-untyped-call]  # Zenoh's stub lacks it
        served = there.declare_queryable("plant/**", saying(("mixer/speed", good(2), None)))
        otherwise = threading.Timer(10, there.put, ("plant/mixer/speed", good(99)))
        otherwise.start()
        token.undeclare()  # type: ignore[no-untyped-call]  # Zenoh's stub lacks it
        while (value := shown_as(news)) == 1:
            pass
        otherwise.cancel()
        assert value == 2


def test_a_block_of_an_older_gateway_may_be_longer_than_what_a_gateway_takes(
    config: Config,
) -> None:
    device = replace(config.lines[0].devices[0], blocks="only")
    config = replace(config, lines=(replace(config.lines[0], devices=(device,)),))
    with (
        answering(config, {"plant/**": saying(("mixer/speed", good(1), None))}) as there,
        connected(config, print) as client,
        closing(client.follow(["**"])) as news,
    ):
        assert shown_as(news) == 1
        large = {"speed": json.loads(good(2)), "other": "x" * 1_000_000}
        there.put("plant/mixer/@block", json.dumps(large))
        there.put("plant/mixer/@block", json.dumps({"speed": json.loads(good(3))}))
        assert shown_as(news) == 2


def test_in_a_standby_group_a_value_after_the_loss_causes_a_new_query(tmp_path: Path) -> None:
    """The token of the new active gateway existed before, so it announces nothing."""
    path = write_config(
        tmp_path / "config.yaml",
        free_endpoint(),
        {"hall": vigor_line("simulator", {"speed": {"address": "D10"}})},
        gateway={"name": "demo", "standby": "hall"},
    )
    with answering(load(path), {}) as there:
        served = there.declare_queryable("plant/**", saying(("mixer/speed", good(1), None)))
        alive = there.liveliness()
        own, other = (alive.declare_token(f"plant/@gateway/{name}") for name in ("demo", "other"))
        with gateway("watch", path, "--json") as watch:
            watch.says('"value": 1')
            served.undeclare()  # type: ignore[no-untyped-call]  # Zenoh's stub lacks it
            own.undeclare()  # type: ignore[no-untyped-call]  # Zenoh's stub lacks it
            watch.says("no-gateway")
            served = there.declare_queryable("plant/**", saying(("mixer/speed", good(2), None)))
            there.put("plant/mixer/speed", good(2))
            watch.says('"value": 2')
        other.undeclare()  # type: ignore[no-untyped-call]  # Zenoh's stub lacks it


def test_in_a_standby_group_the_end_of_a_standby_gateway_changes_no_value(
    config: Config,
) -> None:
    group = replace(config, standby="hall")
    with (
        answering(config, {"plant/**": saying(("mixer/speed", good(1), None))}) as there,
        connected(group, print) as client,
        closing(client.follow(["**"])) as news,
    ):
        token = there.liveliness().declare_token("plant/@gateway/other")
        assert shown_as(news) == 1
        token.undeclare()  # type: ignore[no-untyped-call]  # Zenoh's stub lacks it
        assert shown_as(news) == 1  # queried again
        there.put("plant/mixer/speed", good(2))
        while (value := shown_as(news)) == 1:
            pass
        assert value == 2


@pytest.mark.parametrize(
    ("wanted", "missing"),
    [
        (["mixer/speed"], ""),
        (["mixer/speed", "mixer/count"], "mixer/count"),
        (["**"], "mixer/alarms/door, mixer/label, mixer/count"),
    ],
)
def test_tags_without_a_reply_are_named(config: Config, wanted: list[str], missing: str) -> None:
    told: list[str] = []
    with (
        answering(config, {"plant/**": saying(("mixer/speed", good(1), None))}),
        connected(config, told.append) as client,
    ):
        rows = [row for want in wanted for row in client.values(want)]
        assert client.report_missing(wanted, rows) is not bool(missing)
    named = [sentence.removeprefix("no reply for ") for sentence in told]
    assert [sentence.partition(":")[0] for sentence in named] == [missing] * bool(missing)


def test_of_many_missing_tags_ten_are_named(tmp_path: Path) -> None:
    lines = {"hall": vigor_line("simulator", {f"d{i}": {"address": f"D{i}"} for i in range(50)})}
    many = load(write_config(tmp_path / "many.yaml", free_endpoint(), lines))
    told: list[str] = []
    with answering(many, {}), connected(many, told.append) as client:
        assert not client.report_missing(["**"], [])
    assert "mixer/d0, mixer/d1, " in told[0]
    assert "mixer/d9 and 40 more: " in told[0]


@pytest.mark.parametrize("send", REQUESTS, ids=["write", "command"])
def test_a_sendwithout_a_receiver_is_not_sent(config: Config, send: Request) -> None:
    asked: list[str] = []

    def note(query: zenoh.Query) -> None:
        with query:
            asked.append(str(query.key_expr))

    answers = {"plant/**": note, "plant/**/@set": note, "plant/*/@stop": note, META: note}
    with (
        answering(config, answers),
        connected(config, print) as client,
        pytest.raises(GatewayError, match=r"no gateway accepts plant/mixer/.*: nothing was sent"),
    ):
        send(client)
    assert asked == [META]


@pytest.mark.parametrize("send", REQUESTS, ids=["write", "command"])
@pytest.mark.parametrize("errors", [[], [b"Timeout"]], ids=["nothing", "the time-out of Zenoh"])
def test_a_sendwithout_a_reply_has_an_unknown_result(
    config: Config, send: Request, errors: list[bytes]
) -> None:
    def take(query: zenoh.Query) -> None:
        with query:
            for error in errors:
                query.reply_err(error)

    with (
        answering(config, {"plant/**/@set": take, "plant/*/@stop": take, META: described}),
        connected(config, print) as client,
        pytest.raises(GatewayError, match="no reply: it is unknown whether it was done"),
    ):
        send(client)


@pytest.mark.parametrize("value", [10**20, -(2**63) - 1, 12.5, True, 7, "\u00e9\u4e2d"])
def test_any_value_of_a_tag_can_be_sent(config: Config, value: Value) -> None:
    def echo(query: zenoh.Query) -> None:
        with query:
            assert query.payload is not None
            sent = json.loads(query.payload.to_bytes())
            query.reply(query.key_expr, json.dumps({"value": repr(sent)}))

    answers = {"plant/**/@set": echo, META: described}
    with answering(config, answers), connected(config, print) as client:
        assert client.requests.write("mixer/speed", value) == {"value": repr(value)}


def test_of_a_block_only_wanted_tags_of_the_file_are_shown(tmp_path: Path) -> None:
    tags = {name: {"address": f"D{n}"} for n, name in enumerate(("speed", "level", "a/b"))}
    lines = {"hall": vigor_line("simulator", tags, blocks="only")}
    path = write_config(tmp_path / "config.yaml", free_endpoint(), lines)
    first = saying(*((f"mixer/{name}", good(1), None) for name in tags))
    bad = {"value": None, "quality": "bad", "reason": "no-reply", "time": TIME}
    block = {"level": bad, "old": bad, "a/b": bad, "speed": json.loads(good(2))}
    with (
        answering(load(path), {"plant/**": first}) as there,
        gateway("watch", path, "mixer/speed", "mixer/a/**", "--json", merged=False) as watch,
    ):
        watch.says("mixer/a/b")
        there.put("plant/mixer/@block", b"no JSON")
        there.put("plant/mixer/@block", json.dumps(block))
        watch.says('"value": 2')
        assert watch.end(signal.SIGINT) == 0
        shown = [json.loads(line) for line in watch.lines]
    assert [row["tag"] for row in shown] == ["mixer/speed", "mixer/a/b", "mixer/a/b", "mixer/speed"]
    assert shown[2] == {"tag": "mixer/a/b", **bad}


def test_an_event_of_a_device_that_publishes_only_blocks_is_shown_once(tmp_path: Path) -> None:
    """Events are published one by one too, unlike the other values of the device."""
    reader = {
        "protocol": "frames",
        "framing": {"preset": "vigor-rs", "header": "<STX>", "terminator": "<ETX>"},
        "listen": {
            "scan": {"match": "(?P<code>[0-9]{1,40})", "fields": {"code": {"type": "text"}}}
        },
        "blocks": "only",
        "tags": {"code": {"address": "code", "event": True}},
    }
    line = {"port": "/dev/ttyS9", "baudrate": 9600, "format": "8N1", "devices": {"reader": reader}}
    path = write_config(tmp_path / "config.yaml", free_endpoint(), {"conveyor": line})
    first = saying(("reader/code", good("1"), None))
    with (
        answering(load(path), {"plant/**": first}) as there,
        gateway("watch", path, "--json", merged=False) as watch,
    ):
        watch.says('"1"')
        there.put("plant/reader/@block", json.dumps({"code": json.loads(good("2"))}))
        for code in ("2", "3"):
            there.put("plant/reader/code", good(code))
        watch.says('"3"')
        assert watch.end(signal.SIGINT) == 0
        assert [json.loads(line)["value"] for line in watch.lines] == ["1", "2", "3"]
