"""Settings of a tag by their names in the file, as the tag groups them."""

from dataclasses import fields
from typing import Any

from gateway.tags import Label, Origin, Publishing
from gateway.tags.shaping import Shaping

_GROUPS = {"shaping": Shaping, "publishing": Publishing, "origin": Origin}


def grouped(**settings: Any) -> dict[str, Any]:
    """Returns the arguments of `Tag` for settings such as `scale` and `deadband`."""
    found = dict(settings)
    for name, kind in _GROUPS.items():
        own = {one.name: found.pop(one.name) for one in fields(kind) if one.name in found}
        if own:
            found[name] = kind(**own)
    words = {name: found.pop(name) for name in ("unit", "description") if name in found}
    alarm = found.pop("alarm", None)
    if words or alarm is not None:
        found["features"] = (Label(**words), *filter(None, (alarm,)))
    return found
