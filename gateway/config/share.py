"""A share of a file: several processes run one plant, each with some of its lines and one core.

The first share keeps name, endpoints and page of the file, and is the router of the others, which
are its clients. A file in mode `client` has a router already.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from gateway.config.settings.records import Config, LineConfig
from gateway.config.settings.zenoh_records import LISTEN, ZenohConfig, ZenohMode
from gateway.errors import ConfigError

MOST = 64
_OF_FIRST = ("web",)  # parts with a port of their own
_NOT_SHARED = {"share": "programs at `share` ports", "remote": "files from afar"}


def parse_share(text: str) -> tuple[int, int]:
    """Returns `2/3` as numbers. Raises `ConfigError`."""
    number, _, of = text.partition("/")
    if number.isdecimal() and of.isdecimal() and 1 <= int(number) <= int(of) <= MOST:
        return int(number), int(of)
    raise ConfigError(f"share {text!r}: write for example 2/3, of at most {MOST}")


def folder_of(share: tuple[int, int] | None, folder: Path) -> Path:
    """Returns the folder of the files that a share writes."""
    return folder if share is None or share[0] == 1 else folder / f"share-{share[0]}"


def share_of(config: Config, share: tuple[int, int]) -> Config:
    """Returns the configuration of one share. Raises `ConfigError` if the file cannot be shared."""
    number, of = share
    if found := [why for part, why in _NOT_SHARED.items() if part in config.parts]:
        raise ConfigError(f"a file with {' and '.join(found)} has no shares")
    if any(line.serve for line in config.lines):
        raise ConfigError("a file with lines that `serve` has no shares: masters read all devices")
    if config.folder is not None and number > 1:
        for path in (config.state_file, config.audit_file, *_paths(config)):
            if path is not None and not path.is_relative_to(config.folder):
                raise ConfigError(f"{path}: shares need a relative path; each has its own folder")
    lines = _shares(config, of)[number - 1]
    devices = {device.name for line in lines for device in line.devices}
    parts = {
        name: part for name, part in config.parts.items() if number == 1 or name not in _OF_FIRST
    }
    suffix = "" if number == 1 else f"-{number}"
    return replace(
        config,
        name=config.name + suffix,
        standby=None if config.standby is None else config.standby + suffix,
        zenoh=_session(config.zenoh, number),
        parts=parts,
        lines=lines,
        transfers=tuple(t for t in config.transfers if t.target.partition("/")[0] in devices),
    )


def _paths(config: Config) -> Iterator[Path | None]:
    return (getattr(part, "path", None) for part in config.parts.values())


def _session(zenoh: ZenohConfig, number: int) -> ZenohConfig:
    if zenoh.mode is ZenohMode.CLIENT:
        return zenoh
    if number == 1:
        return replace(zenoh, mode=ZenohMode.ROUTER)
    first = (zenoh.listen or LISTEN)[0]
    here = first.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:")
    return replace(zenoh, mode=ZenohMode.CLIENT, listen=(), connect=(here,))


def _shares(config: Config, of: int) -> Sequence[tuple[LineConfig, ...]]:
    """Returns the lines of each share. Each line, in their order, goes to the share with the least
    to read, so lines that are added at the end move no other."""
    groups = _groups(config)
    if len(groups) < of:
        raise ConfigError(f"the lines make {len(groups)} shares at most: {of} were asked for")
    shares: list[list[LineConfig]] = [[] for _ in range(of)]
    reads = [0.0] * of  # tags a second
    for group in groups:
        least = reads.index(min(reads))
        shares[least] += group
        reads[least] += sum(1 / tag.every for line in group for tag in line.tags) or 1e-9
    return [tuple(one) for one in shares]


def _groups(config: Config) -> list[list[LineConfig]]:
    """Returns the lines in groups that need each other: by transfers, and computed tags."""
    place = {device.name: line.name for line in config.lines for device in line.devices}
    group = {line.name: [line] for line in config.lines}
    ends = ((one.source, one.target) for one in config.transfers)
    pairs = [(a.partition("/")[0], b.partition("/")[0]) for a, b in ends]
    for device in config.devices:
        pairs += [(device.name, one.device) for tag in device.tags for one in tag.origin.inputs]
    for a, b in pairs:
        one, other = group[place[a]], group[place[b]]
        if one is not other:
            one += other
            group.update((line.name, one) for line in other)
    return list({id(one): one for one in group.values()}.values())
