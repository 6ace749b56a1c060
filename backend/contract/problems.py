"""Errors as RFC 9457 says them."""

from typing import Any

from backend.contract.base import Message


class Problem(Message):
    """An error answer (`application/problem+json`)."""

    type: str
    """Name of the error class, e.g. `stale-edit`."""
    title: str
    status: int
    detail: str
    """The one sentence for the operator."""
    details: dict[str, Any] = {}
    """Structured facts, e.g. the other operator's edit."""


class Identity(Message):
    """Who the caller is."""

    user: str
    role: str
    """`operator` or `viewer`."""
