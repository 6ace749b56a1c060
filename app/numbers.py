"""Numbers and times as operators read them."""

import math
from datetime import datetime
from typing import Any

_NARROW_SPACE = "\u202f"
_MINUTE_S, _HOUR_S = 60, 3600


def number(value: Any, digits: int = 4) -> str:
    """Write a number with so many significant digits, thousands apart, without noise at the end.

    Examples
    --------
    >>> number(41.666667), number(0.00002), number(1.0), number(True)
    ('41.67', '2e-05', '1', 'yes')
    """
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, str):
        return value
    if isinstance(value, int) or float(value).is_integer():
        return f"{int(value):,}".replace(",", _NARROW_SPACE)
    if not math.isfinite(value):
        return "–"
    return _rounded(float(value), digits)


def _rounded(value: float, digits: int) -> str:
    decimals = digits - 1 - math.floor(math.log10(abs(value)))
    if decimals <= 0:
        return f"{value:,.0f}".replace(",", _NARROW_SPACE)
    if decimals > digits + 3:
        return f"{value:.{digits - 1}g}"
    return f"{value:,.{decimals}f}".replace(",", _NARROW_SPACE).rstrip("0").rstrip(".")


def quantity(value: Any, unit: str = "", digits: int = 4) -> str:
    """Write a number with its unit.

    Examples
    --------
    >>> quantity([8.333333, 25.0], "ms")
    '8.333 / 25 ms'
    """
    if isinstance(value, (list, tuple)):
        text = " / ".join(number(v, digits) for v in value)
    else:
        text = number(value, digits)
    return f"{text} {unit}".rstrip() if text != "–" else text


def percent(share: float) -> str:
    """Write a share of a whole.

    Examples
    --------
    >>> percent(0.98712), percent(0.00002), percent(1.0)
    ('98.7 %', '0.002 %', '100 %')
    """
    if not math.isfinite(share):
        return "–"
    return f"{number(100.0 * share, 3)} %"


def named(name: str, value: Any, unit: str = "", digits: int = 4) -> str:
    """Write a number with its unit; what is named `..._share` is a share of a whole.

    Examples
    --------
    >>> named("saturated_share", 0.25), named("peak_gray", 29.0, "gray")
    ('25 %', '29 gray')
    """
    is_share = not unit and (name == "share" or name.endswith("_share"))
    if is_share and isinstance(value, (int, float)) and not isinstance(value, bool):
        return percent(float(value))
    return quantity(value, unit, digits)


def duration(seconds: float) -> str:
    """Write how long something takes.

    Examples
    --------
    >>> duration(0.84), duration(42.4), duration(135.0)
    ('0.8 s', '42 s', '2 min 15 s')
    """
    if seconds < 10:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < _MINUTE_S:
        return f"{whole} s"
    if whole < _HOUR_S:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


def moment(when: datetime, now: datetime) -> str:
    """Write when something was, in the server's local time: the time today, else day and time."""
    local, today = when.astimezone(), now.astimezone()
    if local.date() == today.date():
        return f"{local:%H:%M}"
    if local.year == today.year:
        return f"{local.day} {local:%b %H:%M}"
    return f"{local.day} {local:%b %Y}"


_UNITS = {
    "ms": "ms", "us": "µs", "s": "s", "gray": "gray", "rad": "rad", "px": "px", "mm": "mm", "db": "dB",
    "e": "e⁻", "deg": "°", "share": "", "cycles": "cycles",
}  # fmt: skip


def heading(name: str) -> tuple[str, str]:
    """Split a column's name into its words and its unit, as our names carry it.

    Examples
    --------
    >>> heading("brightest_gray"), heading("frames")
    (('brightest', 'gray'), ('frames', ''))
    """
    words = name.split("_")
    if len(words) > 1 and words[-1].lower() in _UNITS:
        return " ".join(words[:-1]), _UNITS[words[-1].lower()]
    return " ".join(words), ""
