"""The `history` commands, and `backup`: recorded samples as CSV or Parquet, a damaged history."""

import sys
import time
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from gateway.cli.client.arguments import matches, wanted_keys
from gateway.cli.history.history_files import Column, new_file, write_csv, write_json, writer_of
from gateway.cli.progress import busy, counted, loaded
from gateway.cli.terminal import AsJson, ConfigPath, TagNames, err
from gateway.config import Config
from gateway.contract.past.buckets import Now
from gateway.contract.past.history_query import HistoryQuery, question
from gateway.contract.past.timerange import TimeRange, time_range
from gateway.errors import ConfigError, Damaged, GatewayError
from gateway.parts.history.answers.bucket_search import BucketSearch
from gateway.parts.history.answers.search import Search
from gateway.parts.history.files.aside import asides, rename
from gateway.parts.history.files.offline import backup as copied
from gateway.parts.history.files.offline import offline
from gateway.parts.history.files.offline import salvage as salvaged
from gateway.parts.history.settings import HistorySection
from gateway.tags import Quality, Reason, Sample, Tag
from gateway.tags.recorded import RecordedQuery
from gateway.tags.sample import has_json, has_value

cli = typer.Typer(help="Recorded samples.", no_args_is_help=True)

_wall = time.time_ns
_SAMPLES = [
    Column("time", "time"),
    Column("tag", "word"),
    Column("value", "value"),
    Column("quality", "word"),
    Column("reason", "word"),
    Column("origin", "word"),
    Column("limited", "word"),
]


@cli.callback()
def commands() -> None:
    """Recorded samples."""


@cli.command()
def export(
    config: ConfigPath,
    tags: TagNames = None,
    period: Annotated[
        str, typer.Option("--time", help="A range as in a query of Zenoh")
    ] = "[now(-1d)..]",
    bucket: Annotated[
        str | None, typer.Option(help="Rows are buckets of this length, such as 1min")
    ] = None,
    agg: Annotated[str | None, typer.Option(help="min,max,mean,last or some of them")] = None,
    quality: Annotated[str, typer.Option(help="good: leave out what is not good")] = "any",
    output: Annotated[
        Path | None, typer.Option(help="A new .csv or .parquet file (default: print CSV)")
    ] = None,
    history: Annotated[
        Path | None, typer.Option(help="Another history file, such as a copy of `backup`")
    ] = None,
    decimal_comma: Annotated[
        bool, typer.Option("--decimal-comma", help="0,1 and ; as German or French Excel reads it")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Export samples of the history file. The gateway may run, or not."""
    if as_json and output is not None:
        raise ConfigError("--json prints the samples: leave out --output")
    plant = loaded(config)
    given = {"time": period, "bucket": bucket, "agg": agg, "quality": quality}
    asked = question({name: text for name, text in given.items() if text is not None}, "time")
    now = _wall()
    asked_period = time_range(asked.time_range, now)
    found = _tags(plant, tags)
    columns = _SAMPLES if asked.bucket is None else _bucket_columns(asked)
    path = history or _path(plant, config)
    with offline(path) as (search, course):
        lost: list[Damaged] = []
        if asked.bucket is None:
            rows = _samples(search, found, asked, asked_period, now, lost)
        else:
            rows = _buckets(course, found, asked, asked_period, now, lost)
        printed = write_json if as_json else partial(write_csv, comma=decimal_comma)
        if output is None and sys.stdout.isatty():
            printed(sys.stdout, columns, rows)
        elif output is None:
            with busy("reading") as report:
                printed(sys.stdout, columns, counted(rows, "rows exported", report))
        else:
            write = writer_of(output, columns, comma=decimal_comma)
            with busy("reading") as report, new_file(output) as unfinished:
                count = write(unfinished, counted(rows, "rows exported", report))
            err.print(f"{output}: {count} rows of {path}")
        if lost:
            raise GatewayError(f"{path}: {lost[0]}; all others were exported")


@cli.command()
def salvage(config: ConfigPath) -> None:
    """Bring back the samples of a history that was moved aside. Stop the gateway first."""
    path = _path(loaded(config), config).resolve()
    with busy("bringing samples back") as report:
        back = salvaged(path, lambda count: report(f"{count:,} samples are back", None))
    err.print(f"{path}: {back} samples are back; the old files are beside it")


@cli.command()
def known(config: ConfigPath) -> None:
    """End the fault of a history that was moved aside. The gateway may run, or not."""
    path = _path(loaded(config), config).resolve()
    found = asides(path)
    if not found:
        raise GatewayError(f"no file beside {path} was moved aside")
    for one in found:
        try:
            err.print(f"{one} is {rename(one, 'known').name} now")
        except OSError as error:
            raise GatewayError(f"{one} was not renamed: {error.strerror}") from None


def backup(
    config: ConfigPath,
    copy: Annotated[Path, typer.Argument(metavar="COPY", help="A file that does not exist yet.")],
) -> None:
    """Copy the history to a file. The gateway may run: nothing waits for it."""
    plant = loaded(config)
    with busy("copying the history"):
        size = copied(_path(plant, config), copy)
    print(f"{copy}: {size / 1e6:.1f} MB")


def _samples(
    search: Search,
    tags: Mapping[str, Tag],
    asked: HistoryQuery,
    period: TimeRange,
    now: int,
    lost: list[Damaged],
) -> Iterator[tuple[Any, ...]]:
    """Yields rows in the order of recording."""
    query = RecordedQuery(tags, asked.time_range, None, now)
    for sample, _ in search.as_recorded(query, period, _nothing):
        if isinstance(sample, Damaged):
            lost.append(sample)
        elif not isinstance(sample, bool) and (has_value(sample) or not asked.only_good):
            yield _row(sample)


def _row(sample: Sample) -> tuple[Any, ...]:
    tag, value = sample.tag, sample.value
    reason = None if sample.reason is None else sample.reason.value
    if sample.quality is Quality.BAD or not has_json(value):
        if sample.quality is not Quality.BAD:
            reason = Reason.NOT_A_NUMBER.value
        return sample.time, tag.key, None, "bad", reason, tag.origin.word, None
    more = tag.origin.word, tag.shaping.limited(value)
    return sample.time, tag.key, value, sample.quality.value, reason, *more


def _buckets(
    course: BucketSearch,
    tags: Mapping[str, Tag],
    asked: HistoryQuery,
    period: TimeRange,
    now: int,
    lost: list[Damaged],
) -> Iterator[tuple[Any, ...]]:
    """Yields rows tag by tag. The last value of a tag is valid as long as a gateway recorded."""
    width = asked.bucket or 0
    for tag in tags.values():
        try:
            for bucket in course.buckets(tag, period, width, Now(now, is_valid=False), _nothing):
                if bucket.quality != "good" and asked.only_good:
                    continue
                values = bucket._asdict()
                yield (
                    bucket.time,
                    tag.key,
                    bucket.quality,
                    *(values[name] for name in asked.aggregates),
                    bucket.good,
                    bucket.bad,
                    bucket.known / 1e9,
                    None if bucket.quality == "good" else bucket.reason,
                    tag.origin.word,
                )
        except Damaged as error:
            lost.append(error)


def _bucket_columns(asked: HistoryQuery) -> list[Column]:
    return [
        Column("time", "time"),
        Column("tag", "word"),
        Column("quality", "word"),
        *(Column(name, "value") for name in asked.aggregates),
        Column("good", "count"),
        Column("bad", "count"),
        Column("known", "number"),
        Column("reason", "word"),
        Column("origin", "word"),
    ]


def _tags(config: Config, names: list[str] | None) -> dict[str, Tag]:
    wanted = wanted_keys(config, names)
    tags = (tag for device in config.devices for tag in device.tags)
    return {tag.recorded_key: tag for tag in tags if matches(tag.key, wanted)}


def _path(config: Config, file: Path) -> Path:
    if (kept := config.part(HistorySection)) is None:
        raise GatewayError(f"{file} has no `history:` section")
    return kept.path


def _nothing() -> None:
    """A command has nobody to give way to."""
