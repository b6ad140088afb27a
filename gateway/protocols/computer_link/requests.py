"""The length of Computer Link requests in format 1, which have no character at their end."""

HEADER = 7  # characters: station, PC number, command, wait
NOT_YET, NEVER = 10_000, 20_000  # longer than any request
_BARE = ("RR", "RS", "MB", "MN", "MW", "PC")
_ENTRY = {"BW": 1, "WW": 4, "BT": 6, "WT": 9, "BM": 5, "WM": 5, "TT": 1}
_HEX = frozenset("0123456789ABCDEF")


def area_length(text: str) -> int:
    """Returns the characters of the area; NOT_YET before, NEVER for an unknown command."""
    command, area = text[4:6], text[HEADER:]
    if len(text) < HEADER:
        return NOT_YET
    if command in _BARE:
        return 0
    if command == "GW":
        return 1
    if command in ("BR", "WR"):
        return 7
    if command not in _ENTRY:
        return NEVER
    before = 5 if command in ("BW", "WW") else 0
    count = area[before : before + 2]
    if len(count) < 2:
        return NOT_YET
    if not _HEX.issuperset(count):
        return NEVER
    entry = 8 if command == "WW" and "CN200" <= area[:5] <= "CN255" else _ENTRY[command]
    return before + 2 + int(count, 16) * entry
