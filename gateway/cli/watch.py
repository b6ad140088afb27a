"""The `watch` command: a live table of values."""

from collections.abc import Iterable, Sequence
from contextlib import suppress

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from gateway.cli.client import TagRow, connected, tags_by_key, wanted_keys
from gateway.cli.progress import loaded
from gateway.cli.tables import print_rows, table_of
from gateway.cli.terminal import AsJson, ConfigPath, TagNames, Utc, err, out
from gateway.tags import Tag


def watch(
    config: ConfigPath, tags: TagNames = None, as_json: AsJson = False, utc: Utc = False
) -> None:
    """Print a live table of values. Ctrl-C ends it."""
    plant = loaded(config)
    wanted, by_key = wanted_keys(plant, tags), tags_by_key(plant)
    live = out.is_terminal and not as_json
    tell = out.print if live else err.print  # above the table
    with suppress(KeyboardInterrupt), connected(plant, tell, waits=True) as client:
        if live:
            show_live(out, client.follow(wanted), by_key, utc=utc)
        else:
            for row in client.follow(wanted):
                print_rows([row], by_key, as_json=as_json, utc=utc)


def show_live(
    screen: Console, news: Iterable[TagRow], tags: dict[str, Tag], *, utc: bool = False
) -> None:
    """Shows a table with the latest row of each tag until `news` ends."""
    rows: dict[str, TagRow] = {}

    def table() -> RenderableType:
        return fitted(screen, [rows[tag] for tag in sorted(rows)], tags, utc=utc)

    with Live(console=screen, refresh_per_second=5, get_renderable=table):
        for row in news:
            rows[row.tag] = row


def fitted(
    screen: Console, rows: Sequence[TagRow], tags: dict[str, Tag], *, utc: bool = False
) -> RenderableType:
    """Returns the table, cut to the height of the screen with the number of hidden rows."""
    room = len(rows) if len(rows) < screen.height else max(screen.height - 2, 0)
    while (
        room
        and _height(screen, table_of(rows[:room], tags, utc=utc)) + (room < len(rows))
        > screen.height
    ):
        room -= 1  # a long text takes several lines
    table = table_of(rows[:room], tags, utc=utc)
    if room == len(rows):
        return table
    note = f"{len(rows) - room} more: name the tags you want to see, or enlarge the window"
    return Group(table, Text(note, overflow="ellipsis", no_wrap=True))


def _height(screen: Console, table: Table) -> int:
    return len(screen.render_lines(table))
