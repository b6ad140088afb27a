"""The `control` command: sends a command like `run` or `stop` to a PLC."""

import json
import sys
from typing import Annotated

import typer

from gateway.cli import completion
from gateway.cli.client import connected
from gateway.cli.progress import loaded
from gateway.cli.terminal import AsJson, ConfigPath, Direct, end, err, printable
from gateway.cli.write import error_code, outcome
from gateway.config.commands import check_command, line_of
from gateway.contract import payload


def control(
    config: ConfigPath,
    device: Annotated[str, typer.Argument(metavar="DEVICE", autocompletion=completion.devices)],
    command: Annotated[str, typer.Argument(metavar="COMMAND", help="run, stop, model ...")],
    argument: Annotated[str, typer.Argument(metavar="[ARGUMENT]", help="text; on, off")] = "",
    without_gateway: Direct = False,
    as_json: AsJson = False,
) -> None:
    """Run or stop a PLC, and other commands that the file allows by `control: true`."""
    plant = loaded(config)
    check_command(plant, device, command)
    if without_gateway:
        from gateway.cli.line import direct

        direct.alone(plant)
        done = direct.run(direct.control(plant, device, command, argument))
        print(payload.outcome(done).decode() if as_json else done.answer)
        return
    with connected(plant, err.print) as client:
        answer = client.requests.control(line_of(plant, device).name, device, command, argument)
    if as_json:
        print(json.dumps(answer))
        if "error" in answer:
            sys.exit(error_code(answer))
        return
    if "error" in answer:
        end(outcome(device, answer), error_code(answer))
    print(printable(str(answer["answer"])))
