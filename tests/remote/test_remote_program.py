"""A file from afar at the real program: signed orders, a kill in the middle, the way back."""

import json
import signal
from functools import partial
from pathlib import Path
from typing import Any

from gateway.config import load
from gateway.contract.documents.catalogue import FILE
from tests.contract.reader import Reader
from tests.e2e.processes import Done, plc_gateway, started, until, write_config
from tests.zenoh_peer import free_endpoint

SECRET = 2 * "0123456789abcdef"
FAITHFUL = Reader(json.loads(FILE.read_text("utf-8")), "plant")


def line(address: str) -> dict[str, Any]:
    device = {"protocol": "vigor", "station": 1, "tags": {"speed": {"address": address}}}
    return {"hall": {"port": "simulator", "devices": {"mixer": device}}}


def remote(*arguments: object, by: str = f"ana:{SECRET}") -> Done:
    return plc_gateway("remote", *arguments, env={"PLC_GATEWAY_WRITER": by})


def is_refused(own: Path, cut: Path) -> bool:
    done = remote(own, cut, "--yes")
    return (done.code, "zenoh.listen changed" in done.err) == (1, True)


def test_a_file_is_given_confirmed_and_put_back_after_a_kill(tmp_path: Path) -> None:
    own, endpoint = tmp_path / "plant.yaml", free_endpoint()
    secret = tmp_path / "writers.txt"
    secret.write_text(f"ana:{SECRET}\nbob:{SECRET[::-1]}\n")
    secret.chmod(0o600)
    sections: dict[str, Any] = {"writers": {"file": "writers.txt"}, "remote": {"writers": ["ana"]}}
    write_config(own, endpoint, line("D0"), **sections)
    new = write_config(tmp_path / "new.yaml", endpoint, line("D1"), **sections)
    cut = write_config(tmp_path / "cut.yaml", free_endpoint(), line("D1"), **sections)
    with started(own) as program:
        # For a second after its start a gateway takes no signature: an older one may be repeated.
        until(partial(is_refused, own, cut), "it looks at the file")
        assert remote(own, new, by=f"bob:{SECRET[::-1]}").code == 1
        assert "would take" in remote(own, new, "--check").out
        done = remote(own, new, "--yes", "--look", "100ms")
        assert (done.code, "is confirmed" in done.out) == (0, True), done.err
        last = remote(own).json
        assert FAITHFUL.violations("remote", last) == []
        assert FAITHFUL.violations("file order", last) == []
        assert (last["state"], last["digest"]) == ("confirmed", load(new).digest)
        patch = tmp_path / "patch.yaml"
        patch.write_text("lines: {hall: {devices: {mixer: {tags: {speed: {address: D1000000}}}}}}")
        done = remote(own, "--patch", patch, "--check")
        assert (done.code, "D1000000" in done.err) == (1, True)
        # Nobody answers the question: it waits, and the gateway dies.
        remote(own, "--rollback", last["before"], "--look", "100ms")
        assert remote(own).json["state"] == "waiting"
        assert "waits for confirmation" in plc_gateway("status", own).out
        program.end(signal.SIGKILL)
    state = tmp_path / "remote.json"
    waits = json.loads(state.read_text())
    state.write_text(json.dumps(waits | {"until": waits["at"]}))  # its time is over
    with started(own) as program:
        program.says("file went back")
        assert load(own).digest == last["digest"]
        assert remote(own).json["state"] == "reverted"
