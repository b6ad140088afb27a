"""Commands from MQTT, and the file of their ids."""

import json
import sqlite3
from pathlib import Path

import aiomqtt

from gateway.bridges.documents import Known


class Commands:
    """The ids of commands and their outcomes, on disk before the command is sent."""

    KEPT = 100_000

    def __init__(self, path: Path) -> None:
        self._db = sqlite3.connect(path, isolation_level=None)
        self._db.execute(
            "CREATE TABLE IF NOT EXISTS commands"
            " (key TEXT, id TEXT, value TEXT, outcome TEXT, PRIMARY KEY (key, id))"
        )

    def begin(self, key: str, number: str, value: str) -> Known | None:
        """Returns the outcome of a known id, None for a new one."""
        select = "SELECT value, outcome FROM commands WHERE key = ? AND id = ?"
        if (row := self._db.execute(select, (key, number)).fetchone()) is None:
            insert = "INSERT INTO commands VALUES (?, ?, ?, NULL)"
            new = self._db.execute(insert, (key, number, value)).lastrowid or 0
            self._db.execute("DELETE FROM commands WHERE rowid <= ?", (new - self.KEPT,))
            return None
        if row[0] != value:
            return {"outcome": "bad-value", "reason": "this id belongs to another value"}
        if row[1] is None:
            return {"outcome": "unclear", "reason": "the bridge ended while it was written"}
        known: Known = json.loads(row[1])
        return known

    def end(self, key: str, number: str, outcome: Known) -> None:
        update = "UPDATE commands SET outcome = ? WHERE key = ? AND id = ?"
        self._db.execute(update, (json.dumps(outcome), key, number))


def parsed(message: aiomqtt.Message) -> Known:
    """Returns `value` and perhaps `id` and `time` of a command. Raises ValueError."""
    command = json.loads(message.payload)
    if not isinstance(command, dict):
        command = {"value": command}
    if "value" not in command or not command.keys() <= {"value", "id", "time"}:
        raise ValueError('a command is a value, or {"value": …, "id": "…", "time": "…"}')
    if not all(isinstance(command.get(name, ""), str) for name in ("id", "time")):
        raise ValueError("`id` and `time` are texts")
    if message.retain:
        raise ValueError("a retained command would be done again after every restart")
    if message.qos and not command.get("id"):
        raise ValueError("MQTT may deliver it twice: give it an id, or publish it with QoS 0")
    return command
