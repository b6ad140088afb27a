"""The page of the bench in a browser, up to 20 named tags."""

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from gateway.cli.bench.api import BenchApi
from gateway.cli.bench.command import serve
from tests.e2e.processes import free_port
from tests.web.browser import Tab
from tests.zenoh_peer import free_endpoint

NAMES = "\n".join(f"tag-{number}" for number in range(20))


@asynccontextmanager
async def benched(path: Path) -> AsyncIterator[tuple[asyncio.Queue[str], BenchApi]]:
    """Yields the addresses that the terminal shows."""
    api, addresses = BenchApi(path, free_endpoint()), asyncio.Queue[str]()
    serving = asyncio.create_task(serve(api, free_port(), addresses.put_nowait))
    try:
        yield addresses, api
    finally:
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)


def shown(selector: str) -> str:
    return f"(document.querySelector({json.dumps(selector)})?.innerText ?? '')"


class BenchPage:
    """Counts the clicks."""

    def __init__(self, tab: Tab) -> None:
        self.clicks = 0
        self._tab = tab

    async def click(self, selector: str, then: str) -> None:
        """Clicks, and waits until `then` is true."""
        self.clicks += 1
        await self._tab.click(selector)
        await self._tab.until(then)

    async def named(self, address: str) -> None:
        """Scans a simulated line, takes its three stations, and names 20 registers of the first:
        the right number gives the type, and a list of names fills the rows below."""
        tab = self._tab
        await tab.open(address.split()[1])
        await tab.until("document.getElementById('protocol')?.options.length > 3")
        # Those that are there, with time enough: a simulated reply is late on a busy machine.
        for field, text in (("stations", "1,2,5"), ("timeout", "60s")):
            await tab.value(f"document.getElementById('{field}').value = '{text}'")
        found = "document.querySelectorAll('#found li').length === 3"
        await self.click("#simulate", found)
        rows = "document.querySelectorAll('#registers tbody tr').length === 32"
        number = f"/[0-9A-F]{{4}}/.test({shown('#registers td:nth-child(3)')})"
        await self.click("#stations-form .main", f"{rows} && {number}")
        await self.click("#registers tr:nth-child(3) td:nth-child(6) button", "true")
        await tab.value(
            "(() => { const data = new DataTransfer();"
            f" data.setData('text', {json.dumps(NAMES)});"
            " document.querySelector('.name').dispatchEvent(new ClipboardEvent('paste',"
            " {clipboardData: data, bubbles: true, cancelable: true})); })()"
        )
        await self.click("#add-tags", f"{shown('#size')} === '20 tags on 1 line'")
