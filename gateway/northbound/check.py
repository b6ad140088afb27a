"""What the gateway would not start with, found without opening anything."""

from gateway.config import Config
from gateway.northbound.session import configure
from gateway.northbound.writers import Writers


def check(config: Config) -> None:
    """Raises `ConfigError` for Zenoh settings and files that `Northbound` would refuse."""
    configure(config.zenoh)
    if config.writers_file is not None:
        Writers(config.writers_file)
