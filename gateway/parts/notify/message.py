"""One message: its texts for people, and its document for programs."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Any, Self
from uuid import uuid4

from gateway.contract.languages import Language, translator
from gateway.parts.notify.watch import Alarm, Notice
from gateway.tags import Priority
from gateway.tags.timestamps import rfc3339

MOST = 50  # alarms in one message; the others are counted
_LONGEST = 200  # characters of a subject
Say = Callable[[str], str]


@dataclass(frozen=True, slots=True)
class Message:
    """`id`: the same for each try, so that a receiver knows a repeat. `time`: ns since 1970."""

    id: str
    time: int
    subject: str
    text: str
    document: Mapping[str, Any]

    def saved(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def restored(cls, known: Mapping[str, Any]) -> Self:
        """Raises `KeyError` and `TypeError` for a damaged file."""
        number, time, document = str(known["id"]), int(known["time"]), dict(known["document"])
        return cls(number, time, str(known["subject"]), str(known["text"]), document)


def message(
    prefix: str, gateway: str, notices: Sequence[Notice], time: int, language: Language = "en"
) -> Message:
    """Returns the message of one rule; `time`: ns since 1970. `language`: of subject and text."""
    say = translator(language)
    number, shown = uuid4().hex, notices[:MOST]
    lines = [_line(one, say) for one in shown]
    if more := len(notices) - len(shown):
        lines.append(say(f"and {more} more: see `plc-gateway alarms`"))
    document = {
        "contract": 1,
        "id": number,
        "time": rfc3339(time),
        "prefix": prefix,
        "gateway": gateway,
        "alarms": [{"event": one.what.value, **one.alarm} for one in shown],
        "more": more,
    }
    subject = f"[{prefix}/{gateway}] {_subject(notices, say)}"[:_LONGEST]
    text = "\n".join([*lines, "", say(f"Gateway {gateway} of {prefix}")])
    return Message(number, time, subject, text, document)


def _subject(notices: Sequence[Notice], say: Say) -> str:
    if len(notices) == 1:
        what, alarm = notices[0]
        return f"{say(f'{_named(alarm)} {what}')}: {_text(alarm, say) or say(alarm['priority'])}"
    counts = Counter((one.what.value, one.alarm["priority"]) for one in notices)
    order = [one.value for one in Priority]
    found = sorted(counts.items(), key=lambda one: order.index(one[0][1]))
    return ", ".join(say(f"{number} {priority} {what}") for (what, priority), number in found)


def _line(notice: Notice, say: Say) -> str:
    what, alarm = notice
    words = [say(f"{_named(alarm)} {what}"), say(f"{alarm['priority']} priority")]
    if alarm["text"]:
        words.append(_text(alarm, say))
    if alarm.get("limit") is not None:
        words.append(say(f"limit {alarm['level']} {_number(alarm['limit'])}"))
    if alarm["value"] is not None and "/" in alarm["alarm"]:
        words.append(say(f"value {_number(alarm['value'])} {alarm['unit']}".rstrip()))
    if alarm.get("detail"):
        words.append(say(str(alarm["detail"])))
    if devices := alarm.get("devices"):
        words.append(say(f"devices {', '.join(map(str, devices))}"))
    if alarm["raised"]:
        raised = datetime.fromisoformat(alarm["raised"]).astimezone()
        words.append(say(f"raised {raised:%Y-%m-%d %H:%M:%S %Z}"))
    return "; ".join(words)


def _text(alarm: Alarm, say: Say) -> str:
    """Returns the text of the file as it is; that of a device or line is the gateway's."""
    return str(alarm["text"] if "/" in alarm["alarm"] else say(alarm["text"]))


def _named(alarm: Alarm) -> str:
    """A simulated alarm must not look like a real one."""
    origin = f" ({alarm['origin']})" if "origin" in alarm else ""
    return f"{alarm['alarm']}{origin}"


def _number(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
