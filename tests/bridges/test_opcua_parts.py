"""Parts of `bridge opcua` without a server: nodes, changes, certificates."""

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from asyncua import ua
from asyncua.server.address_space import AddressSpace

from gateway.bridges.opcua.events import event_id, of_alarm, raised_of
from gateway.bridges.opcua.items import Subscription
from gateway.bridges.opcua.space import MOST_TAGS, Nodes, Tree
from gateway.bridges.opcua.trust import MOST_FILES, Own, Refused, TrustList, make_own
from gateway.bridges.opcua.values import data_value
from gateway.errors import ConfigError
from tests.bridges.opcua_clients import certificate
from tests.bridges.played import META, document

Attribute, Type, Code = ua.AttributeIds, ua.VariantType, ua.StatusCodes
GOOD, BAD = "good", "line-down"


def _known(value: object) -> ua.DataValue:
    found = document(None, BAD) if value is BAD else document(value)
    return data_value(found, Type.Double)


class Plant:
    """A tree of one tag with a client that watches it."""

    def __init__(self, filter_: ua.DataChangeFilter | None, queue: int) -> None:
        self.tree = Tree(2, "plant", lambda _key: self.now)
        self.tree.describe("mixer/speed", META | {"type": "float64", "unit": "rpm"})
        self.now = _known(1.0)
        self.aspace = AddressSpace()
        self.aspace._nodes = Nodes({}, self.tree)  # as `plant_into` does
        made = ua.CreateSubscriptionResult(RevisedPublishingInterval=50.0)
        self.subscription = Subscription(made, self.aspace, None, ua.NodeId(1))
        self.wanted = ua.MonitoredItemCreateRequest(
            ItemToMonitor=ua.ReadValueId(ua.NodeId("mixer/speed", 2), Attribute.Value),
            MonitoringMode=ua.MonitoringMode.Reporting,
            RequestedParameters=ua.MonitoringParameters(
                Filter=filter_, QueueSize=ua.UInt32(queue), ClientHandle=ua.UInt32(7)
            ),
        )

    async def told(self, *values: object) -> list[Any]:
        """Returns what the client is told after these values: value, or None where it is bad."""
        items = self.subscription.monitored_item_srv
        (made,) = await items.create_monitored_items(
            ua.CreateMonitoredItemsParameters(ItemsToCreate=[self.wanted])
        )
        made.StatusCode.check()
        for value in values:
            for handle, tell in list(self.tree.watched["mixer/speed"].items()):
                await tell(handle, _known(value))
        self.found = self.subscription._pop_publish_result().NotificationMessage.NotificationData
        return [one.Value.Value.Value for one in self.found[0].MonitoredItems]


def _deadband(size: float) -> ua.DataChangeFilter:
    return ua.DataChangeFilter(
        ua.DataChangeTrigger.StatusValue, ua.UInt32(ua.DeadbandType.Absolute), size
    )


@pytest.mark.parametrize(
    ("filter_", "values", "told"),
    [
        (None, [1.0, 2.0, 2.0, BAD, 2.0], [1.0, 2.0, None, 2.0]),
        (_deadband(5.0), [2.0, 4.0, 6.5, 8.0], [1.0, 6.5]),  # what creeps is told at last
        (_deadband(5.0), [BAD, 1.0], [1.0, None, 1.0]),
        (ua.DataChangeFilter(ua.DataChangeTrigger.Status), [2.0, BAD], [1.0, None]),
    ],
)
async def test_a_client_is_told_what_it_asked_for_and_every_change_of_quality(
    filter_: ua.DataChangeFilter | None, values: list[object], told: list[object]
) -> None:
    assert await Plant(filter_, 100).told(*values) == told


async def test_the_value_after_lost_ones_is_marked() -> None:
    plant = Plant(None, 2)
    assert await plant.told(2.0, 3.0, 4.0) == [3.0, 4.0]
    first, last = plant.found[0].MonitoredItems
    assert (first.Value.StatusCode.value, last.Value.StatusCode.value) == (0x480, Code.Good)


async def test_a_message_has_an_end_and_the_rest_follows() -> None:
    plant = Plant(None, 1)
    waiting = plant.subscription._triggered_datachanges
    waiting.update({number: [ua.MonitoredItemNotification()] for number in range(1_500)})
    sizes = []
    for more in (True, False):
        result = plant.subscription._pop_publish_result()
        assert result.MoreNotifications == more
        sizes.append(len(result.NotificationMessage.NotificationData[0].MonitoredItems))
    assert sizes == [1_000, 500]


def test_a_tag_of_another_type_stays_the_node_that_clients_watch() -> None:
    tree = Plant(None, 1).tree
    node = ua.NodeId("mixer/speed", 2)

    def kind() -> Any:
        found = tree.node(node)
        assert found is not None
        return found.attributes[Attribute.DataType].value.Value.Value.Identifier

    assert kind() == Type.Double.value
    tree.describe("mixer/speed", META | {"type": "bool"})
    assert kind() == Type.Boolean.value
    assert tree.node(ua.NodeId("mixer/speed@unit", 2)) is None
    assert tree.node(ua.NodeId("/mixer/", 2)) is not None
    assert tree.node(ua.NodeId("mixer/speed", 3)) is None
    tree.tags |= {f"mixer/{number}": META for number in range(MOST_TAGS)}
    assert not tree.describe("mixer/one-too-many", META)


def test_an_event_of_an_alarm_says_which_one_it_was() -> None:
    alarm = {
        "alarm": "mixer/level", "state": "returned", "level": None, "text": "",
        "acknowledged": None,
        "since": None, "raised": "2026-11-20T12:00:00Z", "priority": "critical",
    }  # fmt: skip
    event = of_alarm(alarm, ua.NodeId("c", 2), ua.NodeId("s", 2), Code.BadNoCommunication)

    def field(*path: str) -> Any:
        names = [ua.QualifiedName(name) for name in path]
        return event.field(ua.SimpleAttributeOperand(BrowsePath=names)).Value

    assert [field("ActiveState", "Id"), field("AckedState", "Id"), field("Retain")] == [
        *(False, False, True)
    ]
    assert field("Severity") == 900
    assert field("Quality").value == Code.BadNoCommunication
    assert field("NoSuchField") is None
    assert raised_of(field("EventId"), "mixer/level") == "2026-11-20T12:00:00Z"
    assert raised_of(event_id(alarm), "mixer/other") is None
    assert raised_of(b"\xff\x00", "mixer/level") is None


def test_unknown_certificates_do_not_fill_the_disk(tmp_path: Path) -> None:
    trust = TrustList(tmp_path)
    for number in range(MOST_FILES - 1):
        (tmp_path / "rejected" / f"{number}.der").touch()
    first, second = certificate("first/../../x\n"), certificate("second")
    kept = []
    for sent in (first, second):
        with pytest.raises(Refused) as refused:
            trust.check(sent, datetime.now(UTC))
        assert refused.value.code == Code.BadSecurityChecksFailed
        assert trust.reject(sent)
        kept += list(trust.keep_rejected())
    assert [sentence.partition(" ")[2] for sentence in kept] == [
        "is full: delete the files of clients that you do not know"
    ]
    (found,) = (file for file in (tmp_path / "rejected").iterdir() if file.stat().st_size)
    assert found.name.startswith("first_.._.._x-")
    found.rename(tmp_path / "trusted" / "first.pem")  # DER, whatever its name
    (tmp_path / "trusted" / "notes.txt").write_text("no certificate")
    trust.load()
    trust.check(first, datetime.now(UTC))
    assert "notes.txt is no certificate" in trust.trouble
    with pytest.raises(Refused, match="expired"):
        trust.check(first, datetime.now(UTC) + timedelta(days=40))


def test_a_certificate_is_renewed_with_its_key_or_not_at_all(tmp_path: Path) -> None:
    file, key, is_new = make_own(tmp_path, "urn:test", "192.168.0.7")
    assert (is_new, key.stat().st_mode & 0o777) == (True, 0o600)
    assert make_own(tmp_path, "urn:test", "")[2] is False
    own = Own(file, key)
    assert (own.uri, own.renewed()) == ("urn:test", False)
    before = own.der
    other, other_key, _ = make_own(tmp_path / "other", "urn:other", "")
    other.rename(file)
    with pytest.raises(ConfigError, match="is not the key of"):
        own.renewed()
    assert own.der == before
    other_key.rename(key)
    assert own.renewed()
    assert own.uri == "urn:other"
