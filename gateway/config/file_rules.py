"""The files that the gateway writes are no other file of it: it would move that file aside."""

from collections.abc import Iterator
from pathlib import Path as FilePath

from gateway import files
from gateway.config.messages import Mistakes
from gateway.config.settings.records import Config
from gateway.config.settings.sections import Written, reads, writes

_STATE = ("", ".new", ".bad")
_AUDIT = ("", *(f".{number}" for number in range(1, 10)))


def check_files(config: Config, own: FilePath, mistakes: Mistakes) -> None:
    """`own`: the configuration file."""
    earlier: list[tuple[str, FilePath]] = []
    for one in written(config):
        for what, other in (*_read(config, own), *earlier):
            if not mistakes.has(one.setting) and any(
                files.are_same(FilePath(f"{one.file}{tail}"), other) for tail in one.tails
            ):
                mistakes.add(
                    one.setting,
                    f"{one.file.name} is {what}: name another file, such as {one.example}",
                )
        what = f"a file of {'.'.join(map(str, one.setting))}"
        earlier += [(what, FilePath(f"{one.file}{tail}")) for tail in one.tails]


def written(config: Config) -> Iterator[Written]:
    """Yields the files that the gateway writes."""
    yield from writes(config.parts)
    if config.state_file is not None:
        yield Written(("gateway", "state"), config.state_file, _STATE, "state.json")
    if config.audit_file is not None:
        yield Written(("gateway", "audit"), config.audit_file, _AUDIT, "audit.jsonl")
    if config.writers_state is not None:
        yield Written(("writers", "file"), config.writers_state, _STATE, "writers.txt")


def _read(config: Config, own: FilePath) -> Iterator[tuple[str, FilePath]]:
    zenoh, tls = config.zenoh, config.zenoh.tls
    read = {
        "the configuration file": own,
        "zenoh.config_file": zenoh.config_file,
        "zenoh.password_file": zenoh.password_file,
        "zenoh.users_file": zenoh.users_file,
        "writers.file": config.writers_file,
        "gateway.secret_file": config.secret_file,
        **dict(reads(config.parts)),
    }
    if tls is not None:
        read |= {"zenoh.tls.ca": tls.ca, "zenoh.tls.key": tls.key}
        read |= {"zenoh.tls.certificate": tls.certificate}
    yield from ((what, file) for what, file in read.items() if file is not None)
    yield from (("a sheet of tags", sheet.file) for sheet in config.sheets)
