"""Programs nobody here wrote, as processes: how they are started, and what joins them to us."""

import asyncio
from asyncio.subprocess import PIPE, Process
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

HERE = Path(__file__).parent


@asynccontextmanager
async def running(*command: str | Path, ready: bytes) -> AsyncIterator[Process]:
    """The program, once its output (either stream) has a line with `ready` in it."""
    process = await asyncio.create_subprocess_exec(
        *map(str, command), stdout=PIPE, stderr=asyncio.subprocess.STDOUT, cwd=HERE
    )
    assert process.stdout is not None
    try:
        heard = b""
        async with asyncio.timeout(300):
            while ready not in heard:
                line = await process.stdout.readline()
                heard += line
                assert line, f"{command[0]} ended: {heard.decode()}"
        yield process
    finally:
        if process.returncode is None:
            process.kill()
        await process.communicate()


async def finished(*command: str | Path) -> str:
    """Returns the output of the program, which must exit with code 0."""
    process = await asyncio.create_subprocess_exec(
        *map(str, command), stdout=PIPE, stderr=PIPE, cwd=HERE
    )
    async with asyncio.timeout(300):
        out, err = await process.communicate()
    assert process.returncode == 0, f"{out.decode()}{err.decode()}"
    return out.decode()


@asynccontextmanager
async def pty_pair(folder: Path) -> AsyncIterator[tuple[Path, Path]]:
    ours, theirs = folder / "ours", folder / "theirs"
    ends = [f"pty,raw,echo=0,link={end}" for end in (ours, theirs)]
    async with running("socat", "-d", "-d", *ends, ready=b"starting data transfer loop"):
        yield ours, theirs
