"""Small pieces of HTML. Whatever comes from outside goes through `esc`: viser shows HTML as it gets it."""

import html
from collections.abc import Iterable
from typing import Any, Literal

Tone = Literal["plain", "ok", "warning", "failure", "active", "edited", "dim"]


def esc(text: Any) -> str:
    """Make text harmless."""
    return html.escape(str(text), quote=True)


def tag(element: str, css: str, inner: str = "", **attributes: str) -> str:
    """Wrap HTML that is already harmless into an element; attributes are escaped here."""
    extra = "".join(f' {k.rstrip("_").replace("_", "-")}="{esc(v)}"' for k, v in attributes.items())
    return f'<{element} class="{css}"{extra}>{inner}</{element}>'


def div(css: str, inner: str = "", **attributes: str) -> str:
    """Return a block."""
    return tag("div", css, inner, **attributes)


def span(css: str, inner: str, **attributes: str) -> str:
    """Return an inline piece."""
    return tag("span", css, inner, **attributes)


def chip(text: str, tone: Tone = "plain") -> str:
    """Return a small coloured word."""
    return span(f"ug-chip ug-{tone}", esc(text))


def section(title: str, inner: str, *, note: str = "") -> str:
    """Return a block with a heading."""
    head = f"{esc(title)}{span('ug-note', esc(note)) if note else ''}"
    return div("ug-section", div("ug-heading", head) + inner)


def facts(rows: Iterable[tuple[str, str]]) -> str:
    """Return rows of a name and a value, both plain text."""
    cells = "".join(
        div("ug-fact", span("ug-name", esc(name)) + span("ug-value", esc(value)))
        for name, value in rows
    )
    return div("ug-facts", cells)


def table(head: Iterable[tuple[str, str]], rows: Iterable[Iterable[str]]) -> str:
    """Return a table; the head is (words, unit) per column, cells are plain text."""
    names = "".join(
        f"<th>{esc(words)}{span('ug-unit', esc(unit)) if unit else ''}</th>" for words, unit in head
    )
    body = "".join(f"<tr>{''.join(f'<td>{esc(cell)}</td>' for cell in row)}</tr>" for row in rows)
    return div("ug-table", f"<table><thead><tr>{names}</tr></thead><tbody>{body}</tbody></table>")


def gradient_bar(stops: Iterable[str], low: str, middle: str, high: str) -> str:
    """Return a colour bar with what its ends mean."""
    bar = f'<div class="ug-bar" style="background:linear-gradient(90deg,{",".join(stops)})"></div>'
    ends = "".join(span("", esc(text)) for text in (low, middle, high))
    return div("ug-colourbar", bar + div("ug-ends", ends))


def legend(entries: Iterable[tuple[str, str, str]]) -> str:
    """Return (colour, text, note) as a legend."""
    lines = "".join(
        div("ug-entry", f'<i style="background:{colour}"></i>{span("ug-name", esc(text))}{span("ug-value", esc(note))}')
        for colour, text, note in entries
    )  # fmt: skip
    return div("ug-legend", lines)


def marker(css: str) -> str:
    """Return an invisible mark: style rules reach the control that comes after it."""
    return f'<i class="{css}"></i>'
