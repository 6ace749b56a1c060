"""Values as a sentence has them."""

from typing import Any

_LONGEST = 60


def shown_value(value: Any) -> str:
    """Write a setting's value, short: None is `automatic`.

    Examples
    --------
    >>> shown_value(None), shown_value(3.50), shown_value([1.0, 2.5]), shown_value("fast")
    ('automatic', '3.5', '1, 2.5', 'fast')
    """
    if value is None:
        return "automatic"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, list):
        text = ", ".join(shown_value(v) for v in value)
    else:
        text = str(value)
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."
