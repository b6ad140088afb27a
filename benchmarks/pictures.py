"""The pictures of the status page in docs/: `python -m benchmarks.pictures [--into docs]`.

It runs a gateway with simulated PLCs, a line without its port and some alarms, of which one is
acknowledged, and looks at its page with Chromium: on a desktop and on a phone.
"""

import argparse
import asyncio
import tempfile
from pathlib import Path

from tests.e2e.processes import Program, free_port, plc_gateway, started
from tests.web.browser import browser
from tests.zenoh_peer import free_endpoint

TEXT = """\
gateway: {{name: demo}}
zenoh: {{listen: [{endpoint}]}}
web: {{listen: "127.0.0.1:{port}"}}
history: {{path: history.db}}
defaults: {{every: 500ms}}
lines:
  hall-1:
    port: simulator
    baudrate: 19200
    devices:
      mixer:
        protocol: vigor
        station: 1
        tags:
          speed:
            {{address: D100, scale: 0.1, unit: rpm, alarm: {{high: 0.5, text: Mixer too fast}}}}
          level: {{address: D10, type: float32, alarm: {{high: 95, high_high: 99}}}}
          alarms/door: {{address: M12, description: Guard door open, alarm: {{on: true}}}}
      oven:
        protocol: computer-link
        station: 5
        tags:
          temperature:
            {{address: D0100, unit: °C, history: true, alarm: {{low: 95, text: Oven cold}}}}
          setpoint: {{address: D0101, write: {{min: 20, max: 250}}, unit: °C}}
      dryer:
        {{protocol: computer-link, station: 6, tags: {{humidity: {{address: D0100, unit: "%"}}}}}}
  hall-2:
    port: /dev/ttyUSB7
    baudrate: 9600
    devices:
      drive: {{protocol: modbus-rtu, station: 3, tags: {{actual: {{address: "holding:5"}}}}}}
  boiler-room:
    port: simulator
    baudrate: 9600
    devices:
      boiler: {{protocol: modbus-rtu, station: 9, tags: {{power: {{address: "input:100"}}}}}}
"""
SIZES = {"page": (1000, 1400), "page-phone": (390, 1200)}
EXCHANGES = 90  # on the wire in 10 s, as long as it is shown
PAGE = "#line=hall-1&device=oven"


async def taken(chromium: str, port: int, into: Path, profile: Path) -> None:
    async with browser(chromium, profile) as tab:
        for name, (width, height) in SIZES.items():
            await tab.open("about:blank")  # the same address would not be loaded again
            await tab.look(width, height)
            await tab.open(f"http://127.0.0.1:{port}/{PAGE}")
            await tab.until(
                'document.body?.className === "" && '
                'document.querySelectorAll("#values tr").length > 1 && '
                'document.querySelectorAll("#alarms tr").length > 1 && '
                f"Number(document.body.innerText.match(/(\\d+) exchanges/)[1]) >= {EXCHANGES}"
            )
            await tab.screenshot(into / f"{name}.png")
        assert tab.errors == []


def acknowledged(path: Path, program: Program) -> None:
    """Acknowledges one alarm."""
    program.says("device online", "oven")
    while plc_gateway("alarms", path, "--ack", "oven/temperature", "--by", "Ana").code:
        pass  # until it is raised


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--into", type=Path, default=Path(__file__).parents[1] / "docs")
    parser.add_argument("--chromium", default="chromium")
    parser.add_argument("--after", type=float, default=60.0, help="seconds that the gateway runs")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        path, port = Path(name) / "plant.yaml", free_port()
        path.write_text(TEXT.format(endpoint=free_endpoint(), port=port))
        with started(path) as program:
            acknowledged(path, program)

            async def later() -> None:
                await asyncio.sleep(arguments.after)
                profile = Path(name) / "profile"
                await taken(arguments.chromium, port, arguments.into, profile)

            asyncio.run(later())
            assert program.end() == 0


if __name__ == "__main__":
    main()
