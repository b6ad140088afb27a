"""The log events of the audit: each is an entry of its own, however often it comes.

Refusals of the gateway itself come as fast as a client can send; the audit counts those that it
leaves out (`northbound/requests/audit.py`).
"""

WRITTEN, EXECUTED = "tag written", "command executed"
WRITE_FAILED, WRITE_UNCLEAR = "write failed", "write unclear"
COMMAND_FAILED, COMMAND_UNCLEAR = "command failed", "command unclear"
OF_ALARMS = tuple(
    f"alarm {deed}"
    for deed in ("acknowledged", "shelved", "unshelved", "out of service", "in service")
)
EVENTS = frozenset(
    {
        *(WRITTEN, WRITE_FAILED, WRITE_UNCLEAR),
        *(EXECUTED, COMMAND_FAILED, COMMAND_UNCLEAR),
        *OF_ALARMS,
    }
)
