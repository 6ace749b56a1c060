"""Answers that are bytes, as OpenAPI says them."""

from typing import Any


def binary(media_type: str) -> dict[int | str, dict[str, Any]]:
    """Describe an answer that is bytes, for OpenAPI."""
    schema = {"type": "string", "format": "binary"}
    return {200: {"content": {media_type: {"schema": schema}}, "description": "The bytes."}}
