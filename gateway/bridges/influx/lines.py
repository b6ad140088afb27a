"""Values as lines of InfluxDB's line protocol.

    plc,device=mixer,name=speed value=12.5,good=true 1763640000123456000
    plc,device=mixer,name=name text="AB",good=true 1763640000123456000
    plc,device=mixer,name=recipe value_0=1.0,value_1=5.0,good=true 1763640000123456000
    plc,device=mixer,name=speed good=false,reason="no-reply" 1763640003500000000

* A value at an end of its clamp has `limited="low"` or `limited="high"`.
* An array has a field for each element, `value_0`, `value_1` ...
* Numbers and bits (0, 1) are in `value`, texts and the names of an `enum` in `text`. Beyond 2^53 a
  number is exact in `text` only.
* An uncertain sample, outside the range of its sensor, has its value and `good=false`.
* A bad sample has no value. A chart of the last value must look at the last `good` too.
"""

import re
from datetime import datetime

from gateway.bridges.documents import Known

_SEPARATORS = re.compile(r"([,= \\])")


def line_of(key: str, known: Known) -> str:
    device, _, tag = key.partition("/")
    value = known["value"]
    good = "good=true"
    if known["quality"] != "good":
        good = f"good=false,reason={quoted(known.get('reason', ''))}"
    if value is None:
        fields = good
    elif isinstance(value, list):
        fields = ",".join(f"value_{n}={float(one)!r}" for n, one in enumerate(value)) + f",{good}"
    elif isinstance(value, str):
        fields = f"text={quoted(value)},{good}"
    else:
        fields = f"value={float(value)!r},{good}"
        if isinstance(value, int) and abs(value) > 2**53:
            fields += f",text={quoted(str(value))}"
        elif "text" in known:
            fields += f",text={quoted(str(known['text']))}"
    if "limited" in known:
        fields += f",limited={quoted(known['limited'])}"
    origin = f",origin={escaped(known['origin'])}" if known.get("origin") else ""
    nanoseconds = round(datetime.fromisoformat(known["time"]).timestamp() * 1_000_000) * 1000
    return f"plc,device={escaped(device)},name={escaped(tag)}{origin} {fields} {nanoseconds}"


def quoted(text: str) -> str:
    """Returns a field's text."""
    text = _one_line(text).replace("\\", "\\\\").replace('"', '\\"')
    return f'"{text}"'


def escaped(name: str) -> str:
    """Returns a name as the value of a tag: another program may have any key."""
    return _SEPARATORS.sub(r"\\\1", _one_line(name))


def _one_line(text: str) -> str:
    """The protocol has no escape for a line's end."""
    return " ".join(text.splitlines())
