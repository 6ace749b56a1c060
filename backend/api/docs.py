"""The API's description: as OpenAPI, and as a page that needs neither scripts nor the internet."""

from collections.abc import Iterator, Mapping
from html import escape
from typing import Any

from fastapi import APIRouter, FastAPI, Request
from fastapi.openapi.utils import get_openapi
from starlette.responses import HTMLResponse, JSONResponse, Response

from backend.api.access import session_of
from backend.api.assets import asset
from backend.api.pages import login_page_for
from backend.api.problems import MEDIA_TYPE
from backend.contract.problems import Problem

PROBLEM_RESPONSES: dict[int | str, dict[str, Any]] = {
    "4XX": {
        "description": "An expected error, as one sentence.",
        "content": {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}},
    }
}

router = APIRouter(include_in_schema=False)
page = APIRouter(include_in_schema=False)


@router.get("/openapi.json")
async def openapi(request: Request) -> JSONResponse:
    """Return the OpenAPI document."""
    return JSONResponse(request.app.openapi())


@page.get("/api/docs")
async def docs(request: Request) -> Response:
    """Show the endpoints to whoever is logged in."""
    if session_of(request) is None:
        return login_page_for(request)
    body = "".join(_sections(request.app.openapi()))
    return HTMLResponse(asset("docs.html")[0].decode("utf-8").replace("$body", body))


def described(app: FastAPI) -> dict[str, Any]:
    """Make the OpenAPI document: what FastAPI knows, our form of errors, and how to show who one is."""
    document = get_openapi(
        title=app.title,
        version=app.version,
        description=app.description,
        routes=app.routes,
        separate_input_output_schemas=False,
    )
    components = document.setdefault("components", {})
    components.setdefault("schemas", {})["Problem"] = Problem.model_json_schema()
    components["securitySchemes"] = {
        "token": {"type": "http", "scheme": "bearer"},
        "session": {"type": "apiKey", "in": "cookie", "name": "unglare-PORT"},
    }
    document["security"] = [{"token": []}, {"session": []}]
    return document


def _sections(document: Mapping[str, Any]) -> Iterator[str]:
    schemas = document["components"]["schemas"]
    by_tag: dict[str, list[str]] = {}
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            tag = operation.get("tags", ["other"])[0]
            by_tag.setdefault(tag, []).append(_operation(method, path, operation))
    for tag, operations in by_tag.items():
        yield f"<h2>{escape(tag.capitalize())}</h2>{''.join(operations)}"
    yield "<h2>Messages</h2>"
    for name, schema in sorted(schemas.items()):
        yield f'<details id="{escape(name)}"><summary><code>{escape(name)}</code> {escape(_first(schema))}</summary>{_fields(schema)}</details>'


def _operation(method: str, path: str, operation: Mapping[str, Any]) -> str:
    rows = "".join(_parameter(p) for p in operation.get("parameters", []))
    body = _content(operation.get("requestBody", {}))
    answers = (
        f"{code}: {answer}"
        for code, details in operation["responses"].items()
        if (answer := _content(details))
    )
    facts = [f"<p>Body: {body}</p>"] if body else []
    facts += [f"<table>{rows}</table>"] if rows else []
    return (
        f"<details><summary><b class={method}>{method.upper()}</b> <code>{escape(path)}</code> "
        f"{escape(_first(operation))}</summary>"
        f"<p>{escape(operation.get('description', ''))}</p>{''.join(facts)}"
        f"<p>Answers: {', '.join(answers) or 'nothing'}</p></details>"
    )


def _parameter(parameter: Mapping[str, Any]) -> str:
    return _row(parameter["name"], parameter["schema"], parameter.get("description", ""))


def _fields(schema: Mapping[str, Any]) -> str:
    if "enum" in schema:
        return f"<p>{escape(', '.join(map(str, schema['enum'])))}</p>"
    fields = schema.get("properties", {})
    return (
        f"<table>{''.join(_row(n, f, f.get('description', '')) for n, f in fields.items())}</table>"
    )


def _row(name: str, schema: Mapping[str, Any], text: str) -> str:
    return f"<tr><td><code>{escape(name)}</code><td>{_type(schema)}<td>{escape(text)}"


def _type(schema: Mapping[str, Any]) -> str:
    if "$ref" in schema:
        name = escape(schema["$ref"].rpartition("/")[2])
        return f'<a href="#{name}">{name}</a>'
    if "anyOf" in schema:
        return " or ".join(_type(s) for s in schema["anyOf"])
    if "items" in schema:
        return f"list of {_type(schema['items'])}"
    return escape(str(schema.get("type", schema.get("const", "any"))))


def _content(part: Mapping[str, Any]) -> str:
    kinds = part.get("content", {})
    return ", ".join(
        _type(c["schema"]) if kind.endswith("json") else escape(kind)
        for kind, c in kinds.items()
        if c.get("schema") or not kind.endswith("json")
    )


def _first(described: Mapping[str, Any]) -> str:
    text = str(described.get("description", described.get("summary", "")))
    return text.strip().split("\n")[0]
