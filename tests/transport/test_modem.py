"""The port of a modem: what it refuses, and how it reports a loss."""

import asyncio
from functools import partial

import pytest

from gateway.errors import CallEnded, LineDown
from gateway.transport import (
    ModemAddress,
    ModemSettings,
    Port,
    PortAddress,
    Receiver,
    SerialPath,
    SerialSettings,
    TcpAddress,
    open_modem,
    parse_port,
)
from gateway.transport.modem import ModemPort
from tests.e2e.pty_modem import PtyModem
from tests.line.telephone import Cable
from tests.sim.virtual import on_virtual_time
from tests.transport.ends import RecordingReceiver
from tests.transport.modem import ModemModel

WHERE = ModemAddress(SerialPath("/dev/ttyS0"))
SETTINGS = ModemSettings(number="26204393", guard=0.1)


class Bench:
    """A modem port on the model of a modem."""

    def __init__(self, model: ModemModel | None = None) -> None:
        self.model = model or ModemModel()
        self.receiver = RecordingReceiver()
        self.below: Receiver | None = None
        self.cable: Cable | None = None

    async def open(self) -> ModemPort:
        return await open_modem(
            WHERE, SerialSettings(), SETTINGS, self.receiver, opens=self.below_it
        )

    async def below_it(self, _: PortAddress, __: SerialSettings, receiver: Receiver) -> Port:
        self.below, self.cable = receiver, Cable(self.model, receiver)
        return self.cable


@on_virtual_time
async def test_data_is_refused_between_calls() -> None:
    """A modem takes it for commands."""
    bench = Bench()
    port = await bench.open()
    known = list(bench.model.commands)
    with pytest.raises(CallEnded, match="no call"):
        port.write(b"ATD12345\r")
    await port.dial()
    port.write(b"\x02request")
    assert bench.model.data == b"\x02request"
    await port.hang_up()
    with pytest.raises(CallEnded):
        port.write(b"\x02request")
    assert bench.model.commands == [*known, "ATDT26204393", "ATH"]
    await port.close()


@on_virtual_time
async def test_the_end_of_a_call_is_reported_once_and_the_port_stays() -> None:
    bench = Bench()
    port = await bench.open()
    await port.dial()
    assert bench.cable is not None
    bench.cable.say(b"\x02rep" + bench.model.drop())
    await bench.receiver.until(lambda receiver: bool(receiver.losses))
    assert bench.receiver.data == b"\x02rep"
    [loss] = bench.receiver.losses
    assert isinstance(loss, CallEnded)
    assert str(loss) == "/dev/ttyS0: NO CARRIER"
    await port.hang_up()
    await port.dial()
    assert bench.model.calls == 2
    await port.close()


@on_virtual_time
async def test_a_port_that_is_lost_in_a_dial_ends_the_dial() -> None:
    bench = Bench(ModemModel(dials=("",)))
    port = await bench.open()
    dialling = asyncio.create_task(port.dial())
    await asyncio.sleep(1)
    assert bench.below is not None
    bench.below.lost(LineDown("/dev/ttyS0: unplugged"))
    with pytest.raises(LineDown, match="unplugged") as lost:
        await dialling
    assert not isinstance(lost.value, CallEnded)
    with pytest.raises(LineDown, match="unplugged"):
        await port.dial()
    await port.close()


@on_virtual_time
async def test_a_modem_that_stays_silent_is_a_port_that_cannot_be_opened() -> None:
    bench = Bench(ModemModel(deaf=True))
    with pytest.raises(LineDown, match="does not answer AT commands"):
        await bench.open()


async def test_a_pseudo_terminal_has_no_signals() -> None:
    receiver = RecordingReceiver()
    async with PtyModem(ModemModel()) as modem:
        where = ModemAddress(SerialPath(modem.path))
        port = await open_modem(where, SerialSettings(), SETTINGS, receiver)
        await port.dial()
        port.write(b"\x02request")
        await modem.until(lambda model: model.data == b"\x02request")
        await port.hang_up()
        assert "ATH" in modem.model.commands
        await port.close()
    assert receiver.losses == []


def test_a_modem_is_at_any_real_port() -> None:
    assert parse_port("modem:/dev/ttyS0") == WHERE
    assert parse_port("modem:tcp://10.0.0.7:4001") == ModemAddress(TcpAddress("10.0.0.7", 4001))
    for text in ("modem:simulator", "modem:", "modem:modem:/dev/ttyS0"):
        with pytest.raises(ValueError, match="port"):
            parse_port(text)


class FakeSignals:
    """The signals of a modem that follows them: CD in a call, no call without DTR."""

    def __init__(self, model: ModemModel, *, always: bool = False) -> None:
        """`always`: CD says nothing, as after AT&C0."""
        self.dtr: list[bool] = []
        self._model = model
        self._always = always

    async def carrier(self) -> bool | None:
        return self._always or self._model.online

    async def set_dtr(self, on: bool) -> None:
        self.dtr.append(on)
        if not on:
            self._model.drop()


async def opened(bench: Bench, signals: FakeSignals) -> ModemPort:
    port = ModemPort("/dev/ttyS0", SETTINGS, bench.receiver, answers=False)
    await port.open(partial(bench.below_it, WHERE.port, SerialSettings()), lambda _: signals)
    return port


@on_virtual_time
async def test_the_signal_cd_ends_a_call_without_a_word_of_the_modem() -> None:
    bench = Bench()
    signals = FakeSignals(bench.model)
    port = await opened(bench, signals)
    await port.dial()
    await asyncio.sleep(60)
    assert bench.receiver.losses == []
    bench.model.drop()  # it says nothing to the gateway
    await asyncio.sleep(1)
    assert str(bench.receiver.losses[0]) == "/dev/ttyS0: NO CARRIER (the signal CD is off)"
    await port.close()


@on_virtual_time
async def test_a_signal_cd_that_is_always_on_says_nothing() -> None:
    bench = Bench()
    port = await opened(bench, FakeSignals(bench.model, always=True))
    await port.dial()
    bench.model.drop()
    await asyncio.sleep(60)
    assert bench.receiver.losses == []
    await port.close()


@on_virtual_time
async def test_dtr_hangs_up_where_there_is_one() -> None:
    bench = Bench()
    signals = FakeSignals(bench.model)
    port = await opened(bench, signals)
    await port.dial()
    await port.hang_up()
    assert signals.dtr == [False, True]
    assert "+++" not in bench.model.data.decode()
    await port.dial()
    await port.close()


@on_virtual_time
async def test_a_port_without_dtr_hangs_up_before_it_is_closed() -> None:
    bench = Bench()
    port = await bench.open()
    await port.dial()
    await port.close()
    assert not bench.model.online
    assert bench.model.commands[-1] == "ATH"
