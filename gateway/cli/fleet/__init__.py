"""The `fleet` command: all gateways under a prefix, the worst first."""

from gateway.cli.fleet.command import fleet
