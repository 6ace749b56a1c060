"""Errors as answers: `application/problem+json`, one sentence each (RFC 9457)."""

import re
from collections.abc import Mapping, Sequence
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.responses import HTMLResponse, Response

from backend.api.assets import filled
from backend.api.errors import NotLoggedInError, TooManyAttemptsError
from backend.api.headers import FRAMED_BY_US
from backend.contract.problems import Problem
from backend.domain.errors import UnglareError

MEDIA_TYPE = "application/problem+json"
_LONGEST_VALUE = 80


def install(app: FastAPI) -> None:
    """Make the application answer every expected error as a problem."""
    app.add_exception_handler(UnglareError, _expected)
    app.add_exception_handler(RequestValidationError, _invalid_request)
    app.add_exception_handler(HTTPException, _plain)


def answer(problem: Problem, headers: Mapping[str, str] | None = None) -> Response:
    """Return the answer that carries a problem."""
    return Response(
        problem.model_dump_json(), problem.status, dict(headers or {}), media_type=MEDIA_TYPE
    )


def problem_of(error: UnglareError) -> Problem:
    """Say an expected error as a problem; its type is the class name, `StaleEditError` -> `stale-edit`."""
    words = _words(type(error).__name__.removesuffix("Error"))
    return Problem(
        type="-".join(words),
        title=" ".join(words).capitalize(),
        status=error.status,
        detail=error.sentence,
        details=error.details,
    )


def defect(identifier: str) -> Problem:
    """Say that something broke that shouldn't; the log has the traceback under the identifier."""
    return Problem(
        type="defect",
        title="Defect",
        status=500,
        detail=f"Something broke in the server; its log tells what under {identifier}.",
        details={"id": identifier},
    )


async def _expected(request: Request, error: Exception) -> Response:
    assert isinstance(error, UnglareError)
    return _fitting(request, problem_of(error), _headers(error))


def _fitting(
    request: Request, problem: Problem, headers: Mapping[str, str] | None = None
) -> Response:
    """Answer a person in front of a browser with a page, everybody else with JSON."""
    if "text/html" not in request.headers.get("accept", ""):
        return answer(problem, headers)
    page = filled("error.html", title=problem.title, sentence=problem.detail)
    return HTMLResponse(page, problem.status, {**FRAMED_BY_US, **(headers or {})})


def _headers(error: UnglareError) -> dict[str, str]:
    if isinstance(error, NotLoggedInError):
        return {"WWW-Authenticate": 'Bearer realm="unglare"'}
    if isinstance(error, TooManyAttemptsError):
        return {"Retry-After": str(int(error.wait_s))}
    return {}


async def _invalid_request(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    findings = error.errors()
    more = f" ({len(findings) - 1} more)" if len(findings) > 1 else ""
    problem = Problem(
        type="invalid-request",
        title="Invalid request",
        status=422,
        detail=f"{_finding(findings[0])}{more}.",
        details={"errors": [_finding(finding) for finding in findings[:20]]},
    )
    return _fitting(request, problem)


def _finding(finding: Mapping[str, Any]) -> str:
    """Return `Field X of the body is 'value': what is wrong` without a full stop."""
    place, *path = [str(part) for part in finding["loc"]] or ["request"]
    reason = str(finding["msg"]).rstrip(".")
    if finding["type"] == "json_invalid":
        return f"The body is no JSON: {finding['ctx']['error']}"
    if not path:
        return f"The {place} can't be used: {reason}"
    name = f"Field {'.'.join(path)} of the {place}"
    if finding["type"] == "missing":
        return f"{name} is missing"
    return f"{name} is {_short(finding.get('input'))}: {reason}"


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= _LONGEST_VALUE else text[: _LONGEST_VALUE - 1] + "…"


async def _plain(request: Request, error: Exception) -> Response:
    """Say the framework's own errors (no such address, method not allowed) in our form."""
    assert isinstance(error, HTTPException)
    title = HTTPStatus(error.status_code).phrase
    sentences = {
        404: f"There is nothing at {request.url.path}.",
        405: f"{request.url.path} can't be asked with {request.method}.",
    }
    problem = Problem(
        type="-".join(_words(title.title().replace(" ", ""))),
        title=title.capitalize(),
        status=error.status_code,
        detail=sentences.get(error.status_code, f"{str(error.detail).rstrip('.')}."),
    )
    return _fitting(request, problem, error.headers)


def _words(name: str) -> Sequence[str]:
    return [word.lower() for word in re.findall(r"[A-Z][a-z0-9]*", name)]
