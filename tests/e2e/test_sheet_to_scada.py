"""Goes through docs/sheet-to-scada.md: 300 tags of a sheet, five commands, values on Zenoh."""

import asyncio
import signal
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from gateway.config import load
from tests.e2e.processes import ROOT, gateway, plc_gateway, started, until
from tests.e2e.test_first_plant import Step, normal, steps
from tests.zenoh_peer import ZenohPeer, free_endpoint, free_port

PAGE = "sheet-to-scada.md"


def test_a_sheet_of_300_tags_is_on_zenoh_after_five_commands(tmp_path: Path) -> None:
    first = free_port(3)
    replaced = {f"127.0.0.1:{4001 + i}": f"127.0.0.1:{first + i}" for i in range(3)}
    replaced |= {name: str(ROOT / name) for name in ("config.example.yaml", "examples/tags.csv")}

    def here(text: str) -> str:
        for old, new in replaced.items():
            text = text.replace(old, new)
        return text

    def prints(step: Step) -> bool:
        done = plc_gateway(*map(here, step.command), cwd=tmp_path)
        printed = {normal(line) for line in (done.out + done.err).splitlines()}
        shown = {normal(here(line)) for line in step.shown} - {"…"}
        return shown <= printed

    simulate, new, *rest = steps(PAGE)
    assert [step.command[0] for step in rest] == ["import", "run", "read", "export"]
    path = tmp_path / "plant.yaml"
    with ExitStack() as stack:
        plc = stack.enter_context(gateway(*map(here, simulate.command)))
        plc.says(here(simulate.shown[-2]))
        # On a slow machine the simulated PLC may reply too late for a scan: it writes no file then.
        until(partial(prints, new), "new finds the PLC and writes the file")
        path.write_text(path.read_text("utf-8").replace("tcp/127.0.0.1:7447", free_endpoint()))
        for step in rest:
            if step.command[0] == "run":
                stack.enter_context(started(path)).says("device online")
            elif step.command[0] == "import":
                assert prints(step)  # a second one would be refused
            else:
                until(partial(prints, step), f"{step.command} prints what the page shows")
        assert len(asyncio.run(_values(path))) == 300
        plc.end(by=signal.SIGINT)


async def _values(path: Path) -> set[str]:
    """Returns the keys of all values that a client in another process gets."""
    async with ZenohPeer("client", connect=list(load(path).zenoh.listen)) as client:
        return {str(reply.key) for reply in await client.get("plant/**")}
