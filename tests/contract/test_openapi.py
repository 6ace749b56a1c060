"""The API's description is committed: whoever changes the API sees it in the difference.

To write it anew: `UNGLARE_WRITE_GOLDEN=1 pytest tests/contract/test_openapi.py`.
"""

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.contract.api_server import api, toy_house

GOLDEN = Path(__file__).resolve().parents[1] / "golden" / "openapi.json"


@pytest.fixture(scope="module")
def document(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    folder = tmp_path_factory.mktemp("data")
    with toy_house(folder) as house:
        yield api(house, folder, version="0").openapi()


def operations(document: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    for path, methods in document["paths"].items():
        for method, operation in methods.items():
            yield f"{method} {path}", operation


def test_the_description_is_the_committed_one(document: dict[str, Any]) -> None:
    text = json.dumps(document, indent=1, ensure_ascii=False) + "\n"
    if os.environ.get("UNGLARE_WRITE_GOLDEN"):
        GOLDEN.write_text(text, encoding="utf-8")

    assert json.loads(GOLDEN.read_text(encoding="utf-8")) == json.loads(text), (
        "the API has changed: look whether clients have to change too, then write the file anew"
    )


def test_every_operation_says_what_it_does_and_how_it_fails(document: dict[str, Any]) -> None:
    silent = [name for name, o in operations(document) if not o.get("description")]
    other_errors = [
        name
        for name, o in operations(document)
        if "4XX" not in o["responses"] and name != "get /api/health"
    ]

    assert silent == []
    assert other_errors == []
    assert "HTTPValidationError" not in document["components"]["schemas"]


def test_names_of_operations_are_unique(document: dict[str, Any]) -> None:
    names = [o["operationId"] for _, o in operations(document)]

    assert len(names) == len(set(names))


def test_every_reference_leads_somewhere(document: dict[str, Any]) -> None:
    schemas = document["components"]["schemas"]

    def references(node: Any) -> Iterator[str]:
        if isinstance(node, dict):
            if isinstance(node.get("$ref"), str):
                yield node["$ref"]
            node = list(node.values())
        if isinstance(node, list):
            for inner in node:
                yield from references(inner)

    missing = {r for r in references(document) if r.rpartition("/")[2] not in schemas}
    assert missing == set()
