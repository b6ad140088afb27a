"""The `remote` command: gives a running gateway another file, and confirms it when all is well."""

import json
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from gateway.cli.client import Client, reached
from gateway.cli.fleet.rollout import KEY, LOADING
from gateway.cli.terminal import FAILED, ConfigPath, end, err, out, printable
from gateway.config.settings.parsers import interval
from gateway.config.whole import whole_text
from gateway.config.yaml.file import TEXTS, read_yaml
from gateway.contract.faults import faults
from gateway.errors import ConfigError


def remote(
    config: ConfigPath,
    new: Annotated[Path | None, typer.Argument(metavar="[NEW]", help="The other file.")] = None,
    check: Annotated[bool, typer.Option("--check", help="Check it on the gateway only.")] = False,
    patch: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Settings that change, instead of NEW.")
    ] = None,
    rollback: Annotated[
        str | None, typer.Option(metavar="DIGEST", help="An earlier file instead of NEW.")
    ] = None,
    revert: Annotated[bool, typer.Option("--revert", help="Take back what waits.")] = False,
    yes: Annotated[
        bool, typer.Option("--yes", help="Confirm it without a question, if no fault is new.")
    ] = False,
    look: Annotated[str, typer.Option(help="How long to look for new faults.")] = "20s",
    within: Annotated[str, typer.Option(help="Then an unconfirmed file goes back.")] = "10min",
) -> None:
    """Give a running gateway another file, which goes back by itself unless confirmed."""
    given = [new is not None, patch is not None, rollback is not None, revert]
    if sum(given) > 1 or (check and not any(given[:2])):
        one = "write one of NEW, --patch FILE, --rollback DIGEST and --revert"
        raise ConfigError(f"{one}; --check needs NEW or --patch")
    looks, order = interval(look), _order(new, patch, rollback, check=check, revert=revert)
    with reached(config, err.print) as client:
        if order is None:
            print(json.dumps(client.status(KEY)))
            return
        before = _faults(client)
        if order["do"] in ("apply", "rollback"):
            order["confirm"] = interval(within)
        found = _sent(client, order)
        if found["state"] != "waiting":
            good = "the gateway would take this file"
            out.print(good if check else printable(f"{found['state']}: {found['why']}"))
            return
        out.print(f"loaded; it goes back at {found['until']} unless it is confirmed")
        time.sleep(looks)
        new_faults = _faults(client) - before
        for fault in sorted(new_faults):
            err.print(printable(f"new: {fault}"))
        if new_faults and yes:
            end("a fault is new: the file is not confirmed, and goes back by itself", FAILED)
        if yes or typer.confirm("Keep it?"):
            _sent(client, {"do": "confirm", "digest": found["digest"]})
            out.print(f"{found['digest']} is confirmed")
        else:
            _sent(client, {"do": "revert"})
            out.print("the file before is back")


def _order(
    new: Path | None, patch: Path | None, rollback: str | None, *, check: bool, revert: bool
) -> dict[str, Any] | None:
    """Raises `ConfigError`."""
    do = "check" if check else "apply"
    if patch is not None:
        file, mistakes = read_yaml(patch, TEXTS)
        mistakes.raise_all()
        return {"do": do, "patch": file.data}
    if rollback is not None:
        return {"do": "rollback", "digest": rollback}
    if revert:
        return {"do": "revert"}
    return None if new is None else {"do": do, "file": whole_text(new)}


def _sent(client: Client, order: dict[str, Any]) -> dict[str, Any]:
    answer = client.requests.order(KEY, order, LOADING)
    if "error" in answer:
        end(printable(str(answer["reason"])), FAILED)
    return answer


def _faults(client: Client) -> set[str]:
    """Returns the sentences of what is wrong, without the times in them."""
    return {one.partition(" (for ")[0] for one in faults(client.documents())}
