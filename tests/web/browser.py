"""A real Chromium without a window, driven over its DevTools protocol."""

import asyncio
import base64
import json
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from itertools import count
from pathlib import Path
from typing import Any

import aiohttp

_FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-dev-shm-usage"),
    *("--disable-background-networking", "--disable-extensions", "--disable-component-update"),
    *("--hide-scrollbars", "--force-color-profile=srgb", "--remote-debugging-port=0"),
)
PATIENCE = 300.0  # seconds; never waited for when all is well


class Tab:
    """One page. Every call waits for the answer of the browser."""

    def __init__(self, socket: "aiohttp.ClientWebSocketResponse[bool]") -> None:
        self._socket = socket
        self._numbers = count(1)
        self.errors: list[str] = []  # of the page: exceptions, refused by its policy

    async def call(self, method: str, **parameters: Any) -> Mapping[str, Any]:
        number = next(self._numbers)
        await self._socket.send_json({"id": number, "method": method, "params": parameters})
        async with asyncio.timeout(PATIENCE):
            while True:
                message = json.loads((await self._socket.receive()).data)
                self._note(message)
                if message.get("id") == number:
                    assert "error" not in message, message
                    result: Mapping[str, Any] = message["result"]
                    return result

    def _note(self, message: Mapping[str, Any]) -> None:
        match message:
            case {"method": "Runtime.exceptionThrown", "params": {"exceptionDetails": found}}:
                self.errors.append(json.dumps(found))
            case {"method": "Log.entryAdded", "params": {"entry": {"source": "security"} as found}}:
                self.errors.append(found["text"])

    async def open(self, url: str) -> None:
        for domain in ("Runtime", "Log", "Page"):
            await self.call(f"{domain}.enable")
        await self.call("Page.navigate", url=url)

    async def value(self, expression: str) -> Any:
        """Returns the value of an expression of JavaScript; awaits a promise."""
        answer = await self.call(
            "Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True
        )
        return answer["result"].get("value")

    async def leave(self, expression: str) -> None:
        """Evaluates what loads the page again, and waits until it is loaded."""
        message = {"id": next(self._numbers), "method": "Runtime.evaluate"}
        await self._socket.send_json({**message, "params": {"expression": expression}})
        async with asyncio.timeout(PATIENCE):
            while message.get("method") != "Page.loadEventFired":
                message = json.loads((await self._socket.receive()).data)
                self._note(message)

    async def until(self, expression: str) -> None:
        """Waits until the expression is true, checked at each change of the page."""
        try:
            async with asyncio.timeout(PATIENCE):
                while not await self.value(expression):
                    await asyncio.sleep(0.02)  # the page sends no notice
        except TimeoutError:
            shown = await self.value("document.body?.innerText")
            raise AssertionError(f"{expression} is not true of:\n{shown}\n{self.errors}") from None

    async def look(self, width: int, height: int, *, dark: bool = False) -> None:
        """Sets the size of the window and the colour scheme."""
        await self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=width < 600,
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        await self.call("Emulation.setEmulatedMedia", features=[scheme])

    async def press(self, key: str) -> None:
        for kind in ("keyDown", "keyUp"):
            text = {"text": "\r"} if key == "Enter" and kind == "keyDown" else {}
            await self.call("Input.dispatchKeyEvent", type=kind, key=key, code=key, **text)

    async def type(self, text: str) -> None:
        await self.call("Input.insertText", text=text)

    async def click(self, selector: str) -> None:
        """Clicks the first element of a selector, when it is there."""
        await self.until(f"!!document.querySelector({json.dumps(selector)})")
        await self.value(f"document.querySelector({json.dumps(selector)}).click()")

    async def drag(self, selector: str, begin: float, end: float) -> None:
        """Drags the mouse across an element, from one share of its width to another."""
        rect = f"document.querySelector({json.dumps(selector)}).getBoundingClientRect()"
        left, wide, middle = await self.value(
            f"(({{x, width, y, height}}) => [x, width, y + height / 2])({rect})"
        )
        for kind, share in (
            ("mouseMoved", begin),
            ("mousePressed", begin),
            ("mouseMoved", end),
            ("mouseReleased", end),
        ):
            button = {} if kind == "mouseMoved" and share == begin else {"button": "left"}
            await self.call(
                "Input.dispatchMouseEvent",
                type=kind,
                x=left + wide * share,
                y=middle,
                clickCount=1,
                buttons=1 if button else 0,
                **button,
            )

    async def touch(self, selector: str, *ways: tuple[float, float]) -> None:
        """Moves a finger for each way across an element, between shares of its width."""
        rect = f"document.querySelector({json.dumps(selector)}).getBoundingClientRect()"
        left, wide, middle = await self.value(
            f"(({{x, width, y, height}}) => [x, width, y + height / 2])({rect})"
        )
        await self.call("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=2)
        for step in range(6):
            shares = [begin + (end - begin) * step / 5 for begin, end in ways]
            points = [
                {"x": left + wide * share, "y": middle, "id": number}
                for number, share in enumerate(shares)
            ]
            kind = "touchMove" if step else "touchStart"
            await self.call("Input.dispatchTouchEvent", type=kind, touchPoints=points)
        await self.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])

    async def screenshot(self, path: Path) -> None:
        answer = await self.call("Page.captureScreenshot", format="png")
        path.write_bytes(base64.b64decode(answer["data"]))


@asynccontextmanager
async def browser(chromium: str, profile: Path) -> AsyncIterator[Tab]:
    """Starts Chromium with an empty profile in a folder, and ends it."""
    flags = (*_FLAGS, f"--user-data-dir={profile}", "about:blank")
    process = await asyncio.create_subprocess_exec(
        chromium, *flags, stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.PIPE
    )
    try:
        assert process.stderr is not None
        async with asyncio.timeout(PATIENCE):
            async for line in process.stderr:
                if b"DevTools listening on" in line:
                    break
            else:
                raise AssertionError(f"{chromium} did not start")
        at = line.decode().split("ws://")[1].split("/")[0]
        async with aiohttp.ClientSession() as session:
            async with session.get(f"http://{at}/json/list") as reply:
                [tab] = [one for one in await reply.json() if one["type"] == "page"]
            async with session.ws_connect(tab["webSocketDebuggerUrl"], max_msg_size=0) as socket:
                yield Tab(socket)
    finally:
        process.terminate()
        process._transport.close()  # type: ignore[attr-defined]  # its pipe stays open otherwise
        await process.wait()
