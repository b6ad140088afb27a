"""The files that the gateway writes are no other file of it: it would move that file aside."""

from collections.abc import Iterator
from pathlib import Path as FilePath

from gateway import files
from gateway.config.messages import Mistakes, Path
from gateway.config.settings.records import Config

_HISTORY = ("", "-wal", "-shm", "-journal", ".lock")  # SQLite's files, and the lock
_STATE = ("", ".new", ".bad")


def check_files(config: Config, own: FilePath, mistakes: Mistakes) -> None:
    """`own`: the configuration file."""
    for path, file, tails in _written(config):
        others = [*_read(config, own)]
        if path == ("gateway", "state") and config.history is not None:
            others += [
                ("a file of the history", FilePath(f"{config.history.path}{tail}"))
                for tail in _HISTORY[1:]
            ]
        if path == ("alarms", "path"):
            others += [
                (f"a file of {named[0]}.{named[1]}", FilePath(f"{written}{tail}"))
                for named, written, its in _written(config)
                if named != path
                for tail in its
            ]
        for what, other in others:
            if any(files.are_same(FilePath(f"{file}{tail}"), other) for tail in tails):
                mistakes.add(
                    path, f"{file.name} is {what}: name another file, such as {_MEANT[path]}"
                )


_MEANT: dict[Path, str] = {
    ("history", "path"): "history.db",
    ("gateway", "state"): "state.json",
    ("alarms", "path"): "alarms.json",
    ("writers", "file"): "writers.txt",
}


def _written(config: Config) -> Iterator[tuple[Path, FilePath, tuple[str, ...]]]:
    if config.history is not None:
        yield ("history", "path"), config.history.path, _HISTORY
    if config.state_file is not None:
        yield ("gateway", "state"), config.state_file, _STATE
    if config.alarms.path is not None:
        yield ("alarms", "path"), config.alarms.path, _STATE
    if config.writers_state is not None:
        yield ("writers", "file"), config.writers_state, _STATE


def _read(config: Config, own: FilePath) -> Iterator[tuple[str, FilePath]]:
    zenoh, tls = config.zenoh, config.zenoh.tls
    read = {
        "the configuration file": own,
        "zenoh.config_file": zenoh.config_file,
        "zenoh.password_file": zenoh.password_file,
        "zenoh.users_file": zenoh.users_file,
        "writers.file": config.writers_file,
        "gateway.secret_file": config.secret_file,
        "web.tokens_file": None if config.web is None else config.web.tokens_file,
    }
    if tls is not None:
        read |= {"zenoh.tls.ca": tls.ca, "zenoh.tls.key": tls.key}
        read |= {"zenoh.tls.certificate": tls.certificate}
    yield from ((what, file) for what, file in read.items() if file is not None)
    yield from (("a sheet of tags", sheet.file) for sheet in config.sheets)
