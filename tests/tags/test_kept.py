"""Bits that must stay, and totals of counters: by the times of samples, whatever is lost."""

from pathlib import Path

import pytest

from gateway.config import ConfigErrors, load
from gateway.contract.meta import meta_fields
from gateway.parts.state.part import StateFile
from gateway.tags import Quality, Reason, Sample, Tag, bad, good
from gateway.tags.kept import CounterState
from gateway.tags.mirror import Mirror
from gateway.tags.scan import Decoder, Scan
from gateway.values import Value
from tests.config.test_config import M, tags

MS = 1_000_000


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def tag_of(settings: str) -> Tag:
    Path("plant.yaml").write_text(tags(f"t: {{address: {settings}}}"), encoding="utf-8")
    (tag,) = load("plant.yaml").devices[0].tags
    return tag


class Reads:
    """Reads of one kept tag, as a line delivers them: equal reads move the time of a scan."""

    def __init__(self, tag: Tag, other: str = "") -> None:
        self.tag, (self.raw,) = tag, tag.origin.inputs
        self.mirror = Mirror([tag], 0)
        self._decoder = Decoder([self.raw], [0])
        self._scan: Scan | None = None

    def read(self, unit: int, ms: int) -> list[Sample]:
        """Returns what is published after a read."""
        scan = self._scan
        if scan is None or scan.latest.superseded:
            scan = self._decoder.first([unit], ms * MS)
        elif [unit] == scan.units:
            scan.time = ms * MS
        else:
            scan = self._decoder.after(scan, [unit], ms * MS)
        self._scan = scan
        return self._follow(scan)

    def lose(self, ms: int) -> list[Sample]:
        self._scan = None
        return self._follow([bad(self.raw, Reason.NO_REPLY, ms * MS, "silent")])

    def _follow(self, samples: Scan | list[Sample]) -> list[Sample]:
        changed = self.mirror.update(samples)
        return self.mirror.follow(changed) if changed or self.mirror.pending else []

    def values(self, *reads: tuple[int, int]) -> list[Value | None]:
        """Returns the value after each read of a unit at a time."""
        found = []
        for unit, ms in reads:
            self.read(unit, ms)
            found.append(self.mirror[self.tag].value)
        return found


def test_a_bit_changes_after_it_stayed_so_long() -> None:
    door = Reads(tag_of("M5, debounce: 500ms"))
    assert door.values((0, 0), (1, 100), (1, 400), (1, 599), (1, 600)) == [
        *(False, False, False, False, True),
    ]  # fmt: skip
    assert door.mirror[door.tag].time == 600 * MS


def test_a_bit_that_bounces_does_not_change() -> None:
    door = Reads(tag_of("M5, debounce: 500ms"))
    found = door.values((0, 0), (1, 100), (0, 300), (1, 500), (1, 900), (0, 950), (0, 2000))
    assert not any(found)


def test_one_change_is_published_once_with_the_tag_of_the_file() -> None:
    door = Reads(tag_of("M5, debounce: 500ms"))
    published = [door.read(unit, ms) for unit, ms in ((0, 0), (1, 100), (1, 600), (1, 900))]
    assert published == [
        [good(door.tag, False, 0)],
        [],
        [good(door.tag, True, 600 * MS)],
        [],
    ]


def test_a_bad_read_passes_at_once_and_the_next_good_one_too() -> None:
    door = Reads(tag_of("M5, debounce: 500ms"))
    door.values((0, 0), (1, 100))
    (lost,) = door.lose(200)
    assert lost == bad(door.tag, Reason.NO_REPLY, 200 * MS, "silent")
    assert door.values((1, 300)) == [True]


def test_a_clock_that_is_set_back_begins_the_wait_again() -> None:
    door = Reads(tag_of("M5, debounce: 500ms"))
    assert door.values((0, 9000), (1, 9100), (1, 1000), (1, 1400), (1, 1500)) == [
        *(False, False, False, False, True),
    ]  # fmt: skip


def test_an_inverted_bit_of_a_word_is_debounced() -> None:
    door = Reads(tag_of("D5.3, debounce: 500ms, invert: true, enum: {0: closed, 1: open}"))
    assert door.values((8, 0), (0, 100), (0, 600)) == [False, False, True]
    assert door.tag.shaping.names is not None
    assert door.tag.shaping.names.text(door.mirror[door.tag].value) == "open"


def test_the_values_are_as_new_as_the_last_read() -> None:
    parts = Reads(tag_of("D1, counter: true"))
    parts.values((5, 0), (5, 1000))
    assert parts.mirror[parts.tag] == good(parts.tag, 5, 1000 * MS)


COUNTS: list[tuple[str, list[int], list[Value]]] = [
    ("type: uint16, counter: true", [65530, 65535, 3], [65530, 65535, 65539]),
    ("counter: true", [32767, 0x8000, 0xFFFF, 1], [32767, 32768, 65535, 65537]),
    ("type: bcd16, counter: true", [0x9998, 0x0001], [9998, 10001]),
    ("type: uint8, counter: true", [250, 4], [250, 260]),
    ("counter: {top: 999}", [998, 2], [998, 1002]),
    ("counter: {bits: 8}", [255, 3], [255, 259]),
    ("type: uint16, counter: true, scale: 0.1", [65535, 0, 15], [6553.5, 6553.6, 6555.1]),
    # The PLC began again at 0: no count, and no jump.
    ("type: uint16, counter: true", [5000, 0, 7], [5000, 5000, 5007]),
    ("type: uint16, counter: {most: 100}", [65400, 0, 7], [65400, 65400, 65407]),
    ("type: uint16, counter: {most: 100}", [10, 60000, 60001], [10, 10, 11]),
]  # fmt: skip


@pytest.mark.parametrize(("settings", "units", "totals"), COUNTS)
def test_a_total_goes_on_where_the_counter_begins_again(
    settings: str, units: list[int], totals: list[Value]
) -> None:
    parts = Reads(tag_of(f"D1, {settings}"))
    reads = [(unit, 1000 * n) for n, unit in enumerate(units)]
    assert parts.values(*reads) == totals


def test_a_restart_of_the_plc_after_a_gap_invents_no_jump() -> None:
    parts = Reads(tag_of("D1, type: uint16, counter: true"))
    parts.values((65000, 0))
    parts.lose(1000)
    assert parts.mirror[parts.tag].quality is Quality.BAD
    assert parts.values((3, 2000), (10, 3000)) == [65000, 65007]
    parts.lose(4000)
    assert parts.values((500, 5000)) == [65497]  # counted meanwhile


def test_a_total_goes_on_after_a_restart_of_the_gateway() -> None:
    parts = Reads(tag_of("D1, type: uint16, counter: true"))
    parts.values((65535, 0), (4, 1000))
    file = StateFile(Path("state.json"))
    file.save(file.snapshot([], parts.mirror.counters()))

    again = StateFile(Path("state.json"))
    for unit, total in ((10, 65546), (2, 65540)):  # counted on; began again meanwhile
        restarted = Reads(parts.tag)
        again.restore([])
        restarted.mirror.restore(again.counters)
        assert restarted.values((unit, 2000)) == [total]
        assert again.counters == {"mixer/t D1": CounterState(4, 65540)}
    moved = Reads(tag_of("D2, type: uint16, counter: true"))
    moved.mirror.restore(again.counters)
    assert moved.values((60000, 2000)) == [60000]


def test_meta_describes_a_total() -> None:
    described = meta_fields(tag_of("D1, type: uint16, counter: {most: 50}"))
    assert (described["type"], described["raw_type"]) == ("int64", "uint16")
    assert described["counter"] == {"modulus": 65536, "most": 50}


MISTAKES = [
    ("D1, debounce: 1s",
     "debounce: a int16 has no debounce: only bits have; for numbers use deadband"),
    ("M1, debounce: 1s, write: true", "write: a debounced bit cannot be written: remove write"),
    ("M1, debounce: 1s, heartbeat: 1min",
     "heartbeat: a debounced bit is published when it changes: remove heartbeat"),
    ("M1, counter: true", "counter: a bool has no counter: only whole numbers have"),
    ("D1, type: float32, counter: true",
     "counter: a float32 has no counter: only whole numbers have"),
    ("D1, counter: true, write: true", "write: a total cannot be written: remove write"),
    ("D1, counter: {bits: 17}", "counter: a int16 has no 17 bits"),
    ("D1, counter: {bits: 8, top: 9}", "counter: bits and top say the same: remove one of them"),
    ("D1, counter: {top: 99999}", "counter: 99999 is no value of a int16"),
    ("D1, counter: 16", "counter: 16: write true, or {bits: 16, most: 1000}"),
]  # fmt: skip


@pytest.mark.parametrize(("settings", "says"), MISTAKES)
def test_a_wrong_combination_is_a_mistake(settings: str, says: str) -> None:
    with pytest.raises(ConfigErrors) as caught:
        tag_of(settings)
    place, _, what = says.partition(": ")
    assert caught.value.messages == (f"plant.yaml:8: {M}.tags.t.{place}: {what}",)


def test_a_default_debounce_is_for_bits_that_are_only_read() -> None:
    rows = tags("b: {address: M1}", "w: {address: M2, write: true}", "n: {address: D1}")
    rule = "    defaults: {debounce: 1s}\n    devices:\n"
    Path("plant.yaml").write_text(rows.replace("    devices:\n", rule, 1))
    assert [tag.origin.kept for tag in load("plant.yaml").devices[0].tags] == [1.0, None, None]


def test_a_gateway_with_a_standby_has_no_totals() -> None:
    text = "gateway: {standby: hall}\n" + tags("t: {address: D1, counter: true}")
    Path("plant.yaml").write_text(text)
    with pytest.raises(ConfigErrors, match="a total is kept by one gateway"):
        load("plant.yaml")


def test_copies_of_a_kept_tag_have_their_own_reads() -> None:
    row = "a: {address: M1, debounce: 1s}"
    text = tags(row, row.replace("a:", "b:", 1))
    Path("plant.yaml").write_text(text)
    a, b = load("plant.yaml").devices[0].tags
    assert a.origin.inputs[0] is not b.origin.inputs[0]
    assert b.origin.inputs[0].name == "b"
