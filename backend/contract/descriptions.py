"""Descriptions of methods and stages, as the registry gives them."""

from typing import Any

from backend.contract.base import Message
from backend.domain.states import Review


class InputDescription(Message):
    """One input of a stage."""

    name: str
    type: str
    optional: bool


class ShownDescription(Message):
    """One field of a result that wants to be looked at."""

    name: str
    per_camera: bool
    hint: dict[str, Any]
    """`kind`, `title` and what the kind needs (see backend/domain/hints.py)."""


class StageDescription(Message):
    """One stage of a method."""

    name: str
    title: str
    doc: str
    version: int
    review: Review
    captures: bool
    inputs: tuple[InputDescription, ...]
    output: str
    settings: dict[str, Any]
    """JSON schema; each property carries title, description, unit, auto, advanced."""
    shown: tuple[ShownDescription, ...]


class MethodDescription(Message):
    """One measuring method."""

    name: str
    title: str
    doc: str
    stages: tuple[StageDescription, ...]
    given: tuple[str, ...]
    presets: dict[str, dict[str, Any]]


class MethodList(Message):
    """All methods, and the plug-ins that failed to load."""

    methods: tuple[MethodDescription, ...]
    broken: dict[str, str]
