"""The stores by their addresses. Each is imported when it is used: its packages are an extra."""

from gateway.archive.store import Store
from gateway.bridges.program import packages_of
from gateway.errors import ConfigError


def store_at(place: str) -> Store:
    """Returns the store at an address. Raises `ConfigError`."""
    scheme = place.partition("://")[0] if "://" in place else ""
    match scheme:
        case "postgresql" | "postgres":
            with packages_of("archive in PostgreSQL"):
                from gateway.archive.postgres import PostgresStore

            return PostgresStore(place)
        case "http" | "https":
            from gateway.archive.influx import InfluxStore

            return InfluxStore(place)
        case "" | "file" | "s3":
            with packages_of("archive in Parquet"):
                from gateway.archive.parquet import ParquetStore

            return ParquetStore(place)
    raise ConfigError(
        f"{place}: no store has an address with {scheme}://; use postgresql://user@host/database, "
        "http://host:8086/write?db=name (InfluxDB), s3://bucket/folder or a folder"
    )
