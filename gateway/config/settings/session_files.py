"""The Zenoh session of the file, with the files that it names."""

from dataclasses import replace
from pathlib import Path as FilePath

from gateway.config.messages import Mistakes, Path
from gateway.config.settings.zenoh_records import ZenohConfig
from gateway.files import is_file


def with_files(found: ZenohConfig, folder: FilePath, mistakes: Mistakes) -> ZenohConfig:
    """Returns the session with its paths below `folder`; notes each file that is not there."""

    def file(name: FilePath | None, *place: str) -> FilePath | None:
        return existing_file(name, folder, ("zenoh", *place), mistakes)

    tls = found.tls
    if tls is not None:
        tls = replace(
            tls,
            ca=file(tls.ca, "tls", "ca"),
            certificate=file(tls.certificate, "tls", "certificate"),
            key=file(tls.key, "tls", "key"),
        )
    return replace(
        found,
        config_file=file(found.config_file, "config_file"),
        tls=tls,
        password_file=file(found.password_file, "password_file"),
        users_file=file(found.users_file, "users_file"),
    )


def existing_file(
    name: FilePath | None, folder: FilePath, path: Path, mistakes: Mistakes
) -> FilePath | None:
    """Returns the path of a file that must exist."""
    if name is None:
        return None
    file = folder / name
    if not is_file(file):
        mistakes.add(path, f"there is no file {file}")
    return file
