"""`bridge opcua` with many tags: changes a second at a client that watches all, CPU, losses.

python -m benchmarks.bridge_opcua --tags 20000 --rates 1000 4000 --security encrypt --sessions 100

`--sessions`: so many clients besides, with ten tags each; the limits of the bridge are raised.
"""

import argparse
import asyncio
import logging
import os
import sys
import tempfile
import time
from contextlib import AsyncExitStack
from pathlib import Path

from asyncua import Client, ua
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256
from cryptography import x509

from tests.bridges.opcua_clients import TOKENS, URI, certificate, folder, key
from tests.bridges.played import PlayedGateway
from tests.e2e.processes import Program, free_port
from tests.zenoh_peer import free_endpoint

AT_ONCE = 1_000  # monitored items in one request
OF_EACH = 10  # tags that one of many clients watches
_RAISED = """
import sys
from gateway.bridges.opcua import admission as limits
limits.MOST_CONNECTIONS = limits.MOST_OF_HOST = limits.MOST_SESSIONS = {most}
limits.MOST_OF_USER = limits.MOST_SUBSCRIPTIONS = {most}
from gateway.cli.main import main
main()
"""


MODES = {
    "sign": ua.MessageSecurityMode.Sign,
    "encrypt": ua.MessageSecurityMode.SignAndEncrypt,
}


class Counter:
    """Counts the changes that a client is told, and the marks of lost ones."""

    def __init__(self) -> None:
        self.changes = self.overflows = 0

    def datachange_notification(self, _node: object, _value: object, data: object) -> None:
        self.changes += 1
        code = data.monitored_item.Value.StatusCode  # type: ignore[attr-defined]
        self.overflows += bool(code and code.value & 0x80)


def used(pid: int) -> float:
    """Returns the seconds of CPU of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, fields[11:13])) / os.sysconf("SC_CLK_TCK")


def megabytes(pid: int) -> float:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


async def connected(stack: AsyncExitStack, url: str, security: str, path: Path) -> Client:
    """Returns a client with certificate and user; without security there is neither."""
    client = Client(url, timeout=120, watchdog_intervall=60)
    if security != "none":
        client.application_uri = URI
        client.set_user("ana")
        client.set_password(TOKENS["ana"])
        own = x509.load_der_x509_certificate(certificate("scada"))
        server = x509.load_der_x509_certificate((path / "pki/own/certificate.der").read_bytes())
        # Not `set_security`, which checks the RSA key for 0.3 s before each connection.
        policy = SecurityPolicyBasic256Sha256(server, own, key(), MODES[security])
        client.security_policy = policy
        client.uaclient.set_security(policy)
    return await stack.enter_async_context(client)


async def measure(
    path: Path, tags: int, rates: list[int], seconds: float, security: str, sessions: int
) -> None:
    keys = [f"device-{number // 250:02}/tag-{number % 250:03}" for number in range(tags)]
    about = {key: {"type": "float64", "unit": "rpm"} for key in keys}
    endpoint, url = free_endpoint(), f"opc.tcp://127.0.0.1:{free_port()}"
    folder(path)
    options: tuple[object, ...] = ("--listen", url, "--security", security, "--anonymous")
    options = (*options, "--pki", path / "pki", "--users", path / "users.txt")
    start = ("-c", _RAISED.format(most=sessions + 10)) if sessions else ("-m", "gateway")
    command = (*start, "bridge", "opcua", "--connect", endpoint, *options)
    with PlayedGateway(endpoint, about) as gateway, Program(sys.executable, *command) as bridge:
        await asyncio.to_thread(bridge.says, "listening")
        begun, counter = time.monotonic(), Counter()
        async with AsyncExitStack() as stack:
            client = await connected(stack, url, security, path)
            last = client.get_node(f"ns=2;s={keys[-1]}")
            while not await is_there(last):
                await asyncio.sleep(0.1)
            there, before = time.monotonic(), used(bridge.pid)
            subscription = await client.create_subscription(500, counter, queue_maxsize=10**6)
            for first in range(0, tags, AT_ONCE):
                nodes = [client.get_node(f"ns=2;s={key}") for key in keys[first:][:AT_ONCE]]
                await subscription.subscribe_data_change(nodes, queuesize=10)
            while counter.changes < tags:
                await asyncio.sleep(0.05)
            print(
                f"{tags:,} tags: known after {there - begun:.1f} s, all watched after "
                f"{time.monotonic() - there:.1f} s ({used(bridge.pid) - before:.1f} s of CPU), "
                f"{megabytes(bridge.pid):.0f} MB"
            )
            there, before = time.monotonic(), used(bridge.pid)
            for number in range(sessions):
                one = await connected(stack, url, security, path)
                mine = [keys[(number * OF_EACH + place) % tags] for place in range(OF_EACH)]
                watching = await one.create_subscription(500, Counter())
                await watching.subscribe_data_change(
                    [one.get_node(f"ns=2;s={key}") for key in mine]
                )
            if sessions:
                print(
                    f"{sessions} more sessions after {time.monotonic() - there:.1f} s "
                    f"({used(bridge.pid) - before:.1f} s of CPU), {megabytes(bridge.pid):.0f} MB"
                )
            for rate in rates:
                await offer(gateway, keys, rate, seconds, counter, bridge.pid)


async def is_there(node: object) -> bool:
    try:
        await node.read_data_type()  # type: ignore[attr-defined]
    except ua.UaStatusCodeError:
        return False
    return True


async def offer(
    gateway: PlayedGateway, keys: list[str], rate: int, seconds: float, counter: Counter, pid: int
) -> None:
    """Publishes so many changes a second, and prints what became of them."""
    before, cpu, begun, sent = counter.changes, used(pid), time.monotonic(), 0
    marked = counter.overflows
    while (passed := time.monotonic() - begun) < seconds:
        for _ in range(int(rate * passed) - sent):
            gateway.put(keys[sent % len(keys)], float(begun % 1000 + sent))
            sent += 1
        await asyncio.sleep(0.02)
    busy, took = used(pid) - cpu, time.monotonic() - begun
    arrived = counter.changes - before
    waited = time.monotonic()
    while time.monotonic() - waited < 20 and counter.changes - before < sent:
        await asyncio.sleep(0.1)
    lost = sent - (counter.changes - before)
    print(
        f"{sent / took:,.0f} changes/s offered: {arrived / took:,.0f}/s arrived, {lost:,} lost "
        f"({counter.overflows - marked:,} marks), {100 * busy / took:.0f} % of a core"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tags", type=int, default=20_000)
    parser.add_argument("--rates", type=int, nargs="+", default=[1_000, 2_000, 4_000])
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--security", choices=("none", *MODES), default="none")
    parser.add_argument("--sessions", type=int, default=0)
    given = parser.parse_args()
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)
    with tempfile.TemporaryDirectory() as path:
        made = Path(path) / "opcua"
        asyncio.run(
            measure(made, given.tags, given.rates, given.seconds, given.security, given.sessions)
        )


if __name__ == "__main__":
    main()
