"""What went wrong, as a note for the operator."""

import logging

import httpx

from app.client import ApiError

_LOG = logging.getLogger(__name__)


def words_of(error: Exception) -> tuple[str, str]:
    """Return title and sentence of a note; a defect is also logged, with its traceback."""
    if isinstance(error, ApiError):
        return "Not done", error.problem.detail
    if isinstance(error, httpx.HTTPError):
        return "No answer", "The server doesn't answer; trying again when it does."
    _LOG.error("defect in the user interface", exc_info=error)
    return "Defect", f"The user interface failed: {error}. See the station's log."
