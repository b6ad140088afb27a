"""The folder of a file that the gateway writes: tried before the start, by `check`."""

import os
import tempfile
from pathlib import Path


def trouble(file: Path) -> str | None:
    """Returns why this process cannot write the file; None if it can.

    Writes a page to a file beside it that has no name, or that is removed at once.
    """
    file = Path(os.path.realpath(file))
    if not file.parent.is_dir():
        return f"there is no folder {file.parent}"
    try:
        with tempfile.TemporaryFile(dir=file.parent, buffering=0) as tried:
            tried.write(bytes(4096))
    except OSError as error:
        return f"{file.parent}: {error.strerror}"
    if file.exists() and not (file.is_file() and os.access(file, os.W_OK)):
        return "this user has no right to write it" if file.is_file() else "it is no file"
    return None
