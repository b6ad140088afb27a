"""The short report of a gateway, made from its status documents."""

from collections import Counter

from gateway.contract.documents.fleet import ReportDocument
from gateway.contract.faults import Documents, below, coded_faults, disk_days, warnings

MOST_TEXT = 300  # characters of a sentence


def report(documents: Documents) -> ReportDocument:
    """Returns what somebody who looks after many gateways needs to know of one."""
    status, reload = documents["status"], documents.get("reload", {})
    found = [*coded_faults(documents)]
    loads = [line["measured"]["load"] for _, line in below("lines/", documents)]
    days = [one["days"] for _, one in below("certificates/", documents)]
    why = reload.get("why", ())
    return {
        "contract": status["contract"],
        "name": status["name"],
        "version": status["version"],
        "time": status["time"],
        "up": status["up"],
        "tags": status["tags"],
        "not_real": bool(status["simulated"] or status["replayed"]),
        "lines": len(status["lines"]),
        "lines_down": sum(not is_open for is_open in status["lines"].values()),
        "devices": dict(Counter(status["devices"].values())),
        "load": max((load for load in loads if load is not None), default=None),
        "faults": dict(Counter(one.code for one in found)),
        "fault": found[0].text[:MOST_TEXT] if found else "",
        "warnings": sum(1 for _ in warnings(documents)),
        "digest": reload.get("digest", ""),
        "revision": reload.get("revision"),
        "loaded": reload.get("loaded"),
        "refused": reload.get("refused"),
        "refused_why": why[0][:MOST_TEXT] if why else "",
        "certificate_days": min((left for left in days if left is not None), default=None),
        "disk_days": disk_days(documents),
        "group": documents.get("standby", {}).get("group"),
        "stand": documents.get("standby", {}).get("stand"),
    }
