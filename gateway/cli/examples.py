"""Two examples for the `--help` of each command, as people copy them."""

from collections.abc import Mapping

# A command that takes one argument at most has one.
EXAMPLES: Mapping[str, tuple[str, ...]] = {
    "run": ("plant.yaml", "plant.yaml --log-format json"),
    "demo": ("", "--no-browser"),
    "check": ("plant.yaml", "plant.yaml --strict --json"),
    "read": ("plant.yaml mixer", "plant.yaml mixer/speed --direct"),
    "write": ("plant.yaml mixer/recipe 7", "plant.yaml mixer recipe=7 speed=12.5"),
    "watch": ("plant.yaml", "plant.yaml 'mixer/**' --json"),
    "control": ("plant.yaml mixer stop", "plant.yaml mixer model --direct"),
    "scan": (
        "--port /dev/ttyUSB0 --protocol vigor",
        "--port tcp://10.0.0.7:4001 --protocol modbus-rtu --stations 1-31 --json",
    ),
    "peek": (
        "plant.yaml mixer D100..D119 --watch",
        "D100..D119 --port /dev/ttyUSB0 --protocol vigor --station 1",
    ),
    "new": ("plant.yaml", "plant.yaml --port /dev/ttyUSB0 --protocol vigor --tags tags.csv"),
    "bench": ("plant.yaml", "plant.yaml --at 8001"),
    "import": ("tags.csv", "tags.xlsx --into plant.yaml --device mixer"),
    "export": ("plant.yaml --output tags.csv", "plant.yaml mixer --decimal-comma"),
    "simulate": ("plant.yaml --tcp 127.0.0.1:5020", "plant.yaml --links /tmp/plant"),
    "status": ("plant.yaml --watch", "plant.yaml --json"),
    "health": ("plant.yaml", "plant.yaml --strict"),
    "fleet": (
        "works --folder files --remember seen.json",
        "works render station.yaml stations.csv files",
        "works apply files --canary 3 --wait 10min --connect tcp/router:7447",
    ),
    "remote": ("plant.yaml new.yaml", "plant.yaml new.yaml --yes --within 5min"),
    "ca create": ("pki --at ca.plant:8444", "pki --days 1825"),
    "ca issue": ("pki hall gateway.plant 10.0.0.5", "pki scada --client --json"),
    "ca serve": ("pki", "pki --at ca.plant:8444 --listen 10.0.0.9:8444"),
    "ca invite": ("pki hall", "pki hall gateway.plant 10.0.0.5 --for 1d"),
    "ca list": ("pki", "pki --json"),
    "ca revoke": ("pki hall",),
    "enrol": ("CODE", "--renew --folder /var/lib/plc-gateway/hall/pki"),
    "line": ("plant.yaml hall-1", "plant.yaml hall-1 release"),
    "doctor": ("plant.yaml", "plant.yaml --json"),
    "alarms": ("plant.yaml", "plant.yaml --ack mixer/level --by ana"),
    "notify": ("plant.yaml", "plant.yaml mail"),
    "audit": ("plant.yaml", "plant.yaml --time '[now(-1d)..]'"),
    "trace": ("plant.yaml hall-1", "plant.yaml hall-1 --for 30s --record recording"),
    "replay": ("recording", "recording --config plant.yaml --check"),
    "backup": ("plant.yaml copy.db",),
    "bridge opcua": (
        "--users users.txt --writer ana",
        "--connect tcp/10.0.0.5:7447 --listen opc.tcp://0.0.0.0:4840 --users users.txt --writes",
    ),
    "bridge mqtt": ("--broker mqtt://127.0.0.1:1883", "--broker mqtts://ana@broker --writes"),
    "bridge influx": ("", "--to 'http://127.0.0.1:8086/api/v2/write?org=o&bucket=plant'"),
    "archive run": ("/srv/archive", "postgresql://archive@db/plant --connect tcp/router:7447"),
    "archive status": ("/srv/archive", "postgresql://archive@db/plant --json"),
    "schema": ("", "--contract"),
    "version": ("",),
    "history export": (
        "plant.yaml mixer/speed --time '[now(-8h)..]'",
        "plant.yaml 'mixer/**' --bucket 15min --output mixer.csv",
    ),
    "history salvage": ("plant.yaml",),
    "history known": ("plant.yaml",),
}


def epilog(command: str) -> str:
    """Returns the end of its help. A line of its own for each example."""
    shown = [f"  plc-gateway {command} {one}".rstrip() for one in EXAMPLES.get(command, ())]
    return "\b\n" + "\n".join(["Examples:", *shown]) if shown else ""
