"""The Zenoh session of the file, with the files that it names."""

from pathlib import Path as FilePath

from gateway.config.messages import Mistakes, Path
from gateway.config.session_model import ZenohSection
from gateway.config.zenoh_records import TlsConfig, ZenohConfig, ZenohMode


def zenoh_config(found: ZenohSection, folder: FilePath, mistakes: Mistakes) -> ZenohConfig:
    """Returns the session. Paths are relative to `folder`; notes each file that is not there."""

    def file(name: FilePath | None, *place: str) -> FilePath | None:
        return existing_file(name, folder, ("zenoh", *place), mistakes)

    tls = found.tls
    return ZenohConfig(
        prefix=found.prefix,
        mode=ZenohMode(found.mode),
        listen=tuple(found.listen),
        connect=tuple(found.connect),
        config_file=file(found.config_file, "config_file"),
        tls=None
        if tls is None
        else TlsConfig(
            ca=file(tls.ca, "tls", "ca"),
            certificate=file(tls.certificate, "tls", "certificate"),
            key=file(tls.key, "tls", "key"),
            mutual=tls.mutual,
        ),
        user=found.user,
        password_file=file(found.password_file, "password_file"),
        users_file=file(found.users_file, "users_file"),
        refresh=found.refresh,
    )


def existing_file(
    name: FilePath | None, folder: FilePath, path: Path, mistakes: Mistakes
) -> FilePath | None:
    """Returns the path of a file that must exist."""
    if name is None:
        return None
    file = folder / name
    if not file.is_file():
        mistakes.add(path, f"there is no file {file}")
    return file
