"""Splits the `@block` of a device, because many clients drop long messages."""

from gateway.contract.payload import LONGEST_REASON
from gateway.tags import Sample

LONGEST_BLOCK = 60_000  # bytes: one message of Zenoh has 65,535
_ELEMENT_SIZE = 5  # characters of a text that take as long as the longest number and its comma
_SAMPLE_SIZE = 130  # bytes of a sample without its texts, of which its value has 40 at most


def parts_of(block: dict[str, Sample]) -> list[dict[str, Sample]]:
    """Splits a block so that no part is longer than `LONGEST_BLOCK`."""
    parts, left = list[dict[str, Sample]](), 0
    for name, sample in block.items():
        size = _longest(name, sample)
        if size > left:
            parts.append({})
            left = LONGEST_BLOCK
        parts[-1][name] = sample
        left -= size
    return parts


def _longest(name: str, sample: Sample) -> int:
    """Returns at least the bytes of the sample in a block: a character has 6 at most."""
    value = sample.value
    text = len(value) if isinstance(value, str) else 0
    if isinstance(value, tuple):
        text = _ELEMENT_SIZE * len(value)
    return _SAMPLE_SIZE + 6 * (len(name) + text + min(len(sample.detail or ""), LONGEST_REASON))
