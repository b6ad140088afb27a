"""Framings under the names of the instructions and modules that use them.

vb-1com        Vigor VB-1COM, formats 1..9 (Vigor VB/VH manual B-4)
vigor-rs       Vigor RS instruction: start code, end code (D9124, D9125)
ex485lnk-user  Liyan EX485LNK, user control mode
k120s-drcv     LS MASTER-K120S DRCV: by length, or by last byte, which stays in the data
k120s-dsnd     LS MASTER-K120S DSND: the data and nothing around it
"""

from dataclasses import fields, replace
from functools import lru_cache
from typing import Literal, NamedTuple

from gateway.errors import ConfigError
from gateway.protocols.frames.bytetext import octets
from gateway.protocols.frames.framing import DEFAULT_GAP, Framing


class _Format(NamedTuple):
    terminator: bool
    sum_check: bool
    ending: Literal["", "CR", "CR LF"]


_VB_1COM = {
    1: _Format(False, False, ""),
    2: _Format(True, False, ""),
    3: _Format(True, False, "CR"),
    4: _Format(True, False, "CR LF"),
    5: _Format(True, True, ""),
    6: _Format(True, True, "CR"),
    7: _Format(True, True, "CR LF"),
    8: _Format(False, False, "CR"),
    9: _Format(False, False, "CR LF"),
}


@lru_cache(maxsize=256)
def written_out(framing: Framing) -> Framing:
    """Returns the same framing without its preset, all settings explicit. Raises `ConfigError`."""
    match framing.preset:
        case None:
            return framing
        case "vb-1com":
            return _vb_1com(framing)
        case "vigor-rs":
            return _vigor_rs(framing)
        case "ex485lnk-user":
            return _ex485lnk(framing)
        case "k120s-drcv":
            return _k120s_drcv(framing)
        case "k120s-dsnd":
            _takes(framing, "gap")
            return replace(framing, preset=None, max_length=255)


def _vb_1com(framing: Framing) -> Framing:
    _takes(
        framing,
        *("format", "header", "terminator", "sum_header_rule", "conversion"),
        *("buffer", "length", "max_length", "gap", "ends"),
    )
    number = framing.format
    if number not in _VB_1COM:
        raise ConfigError(f"preset vb-1com needs a format 1..9, not {number}")
    layout = _VB_1COM[number]
    if layout.terminator and not framing.terminator:
        raise ConfigError(f"format {number} of vb-1com needs a terminator")
    if framing.terminator and not layout.terminator:
        raise ConfigError(f"format {number} of vb-1com has no terminator")
    if layout.sum_check and not framing.header:
        raise ConfigError(f"format {number} of vb-1com needs a header")
    _check_first_byte(framing)
    return replace(
        framing, preset=None, format=None, sum_check=layout.sum_check, ending=layout.ending
    )


def _vigor_rs(framing: Framing) -> Framing:
    _takes(framing, "header", "terminator", "buffer", "length", "max_length", "gap", "ends")
    for name, text in (("header", framing.header), ("terminator", framing.terminator)):
        if len(octets(text)) > 1:
            raise ConfigError(f"vigor-rs has a {name} of one byte, not {text!r}")
    gap = DEFAULT_GAP if framing.gap is None else framing.gap
    return replace(_limited(framing, 256), gap=gap)


def _ex485lnk(framing: Framing) -> Framing:
    _takes(framing, "header", "terminator", "buffer", "length", "max_length", "gap", "ends")
    _check_first_byte(framing)
    return _limited(framing, 128 if framing.buffer == 16 else 64)


def _k120s_drcv(framing: Framing) -> Framing:
    _takes(framing, "terminator", "length", "gap")
    if (framing.length is None) == (not framing.terminator):
        raise ConfigError("k120s-drcv ends by length or by terminator: write one of them")
    if framing.terminator and len(octets(framing.terminator)) != 1:
        raise ConfigError(f"k120s-drcv ends at one last byte, not at {framing.terminator!r}")
    if framing.length is not None:
        return _limited(framing, 255)
    return replace(framing, preset=None, max_length=254, keep_terminator=True)


def _limited(framing: Framing, most: int) -> Framing:
    if framing.longest > most and (framing.length or framing.max_length):
        raise ConfigError(f"{framing.preset} holds {most} bytes, not {framing.longest}")
    if framing.length is not None:
        return replace(framing, preset=None)
    return replace(framing, preset=None, max_length=min(framing.longest, most))


def _takes(framing: Framing, *names: str) -> None:
    for setting in fields(framing):
        untouched = getattr(framing, setting.name) == setting.default
        if setting.name != "preset" and setting.name not in names and not untouched:
            raise ConfigError(f"preset {framing.preset} has no setting {setting.name}")


def _check_first_byte(framing: Framing) -> None:
    """BFM#29 error 9. Which end of a longer terminator is its first byte, the manuals leave open:
    there, one end in range is enough."""
    terminator = octets(framing.terminator)
    if terminator and not any(1 <= end <= 0x1F for end in (terminator[0], terminator[-1])):
        raise ConfigError(
            f"error 9: the first byte of terminator {framing.terminator!r} is not 01h..1Fh"
        )
