"""The `read` command: the current values, from the gateway or from the PLC."""

import sys
from typing import Annotated

import typer

from gateway.cli.client import connected, matches, tags_by_key, wanted_keys
from gateway.cli.progress import loaded
from gateway.cli.tables import is_good, print_rows, row_of
from gateway.cli.terminal import FAILED, AsJson, ConfigPath, Direct, TagNames, Utc, err
from gateway.contract.keys import max_age as parse_max_age
from gateway.errors import GatewayError


def read(
    config: ConfigPath,
    tags: TagNames = None,
    without_gateway: Direct = False,
    max_age: Annotated[
        str | None, typer.Option(help="Read the PLC if the sample is older, e.g. 0s")
    ] = None,
    as_json: AsJson = False,
    utc: Utc = False,
) -> None:
    """Print the current values, through the running gateway or --direct from the PLC."""
    plant = loaded(config)
    wanted, by_key = wanted_keys(plant, tags), tags_by_key(plant)
    complete = True
    if max_age is not None:
        parse_max_age(max_age)  # reports a mistake even when no gateway runs
    if without_gateway:
        from gateway.cli.line import direct

        chosen = [tag for key, tag in by_key.items() if matches(key, wanted)]
        direct.alone(plant)
        samples = direct.run(direct.read(plant, chosen))
        rows = [row_of(sample) for sample in samples]
        for failure in dict.fromkeys(f"{s.tag.device}: {s.detail}" for s in samples if s.detail):
            err.print(failure)
    else:
        with connected(plant, err.print) as client:
            rows = [row for key in wanted for row in client.values(key, max_age)]
            if not rows:
                raise GatewayError(client.no_reply)
            complete = client.report_missing(wanted, rows)
    print_rows(rows, by_key, as_json=as_json, utc=utc)
    if not (complete and all(map(is_good, rows))):
        sys.exit(FAILED)
