"""Whatever is sent to a rig's addresses is answered in one sentence, and nothing breaks.

The operations are those of the API's own description: a new one is tried as well.
"""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.contract.api_server import api, program, serving, toy_house

DESCRIPTION = json.loads(
    (Path(__file__).resolve().parents[1] / "golden" / "openapi.json").read_text("utf-8")
)
OPERATIONS = [
    (verb, path)
    for path, verbs in DESCRIPTION["paths"].items()
    for verb in verbs
    if path.startswith("/api/rigs") and verb in ("get", "post", "put", "delete")
]
EXPECTED = {200, 202, 204, 400, 404, 409, 413, 422, 502}

_WORDS = st.sampled_from(
    ["repetitions", "exposure_ms", "gain_db", "snap", "pattern", "level", "addresses", "seed", "broken", "x", "y",
     "max_px", "part_px", "marks", "options", ""]
)  # fmt: skip
# `search` is left out: that one broadcasts.
_NAMES = _WORDS | st.text(max_size=12).filter(lambda name: name != "search")
_LEAVES = (
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=30)
    | st.sampled_from(["white", "gray", "focus", "127.0.0.1", "0.0.0.0", "255.255.255.255", "224.0.0.1"])
)  # fmt: skip
_VALUES = st.recursive(
    _LEAVES,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(_NAMES, inner, max_size=4),
    max_leaves=12,
)
_SENSIBLE = st.fixed_dictionaries(
    {},
    optional={
        "repetitions": st.integers(0, 200),
        "exposure_ms": st.floats(),
        "gain_db": st.floats(),
        "snap": _LEAVES,
        "pattern": _LEAVES,
        "level": st.integers(-1, 300),
    },
)
BODIES = (
    st.one_of(_VALUES, _SENSIBLE).map(json.dumps).map(lambda text: text.encode("utf-8", "replace"))
    | st.binary(max_size=40)
    | st.sampled_from([b"", b"[" * 100_000, b'{"a":' * 20_000, b"1" * 5_000, b'"\\ud800"', b"{\xff}"])
)  # fmt: skip
RIGS = st.sampled_from(["toy", "other", "nobody"]) | st.text(min_size=1, max_size=20)
QUERIES = st.dictionaries(_NAMES, st.text(max_size=8) | st.integers().map(str), max_size=3)


@pytest.fixture(scope="module")
def operator(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    folder = tmp_path_factory.mktemp("data")
    with toy_house(folder) as house, serving(api(house, folder)) as address, program(address) as client:  # fmt: skip
        yield client


@pytest.mark.parametrize(("verb", "path"), OPERATIONS, ids=lambda word: str(word))
@settings(max_examples=10, deadline=None, suppress_health_check=list(HealthCheck))
@given(rig=RIGS, camera=st.sampled_from(["left", "top"]) | st.text(max_size=8), body=BODIES, query=QUERIES)  # fmt: skip
def test_whatever_is_sent_is_answered_in_one_sentence(
    operator: httpx.Client, verb: str, path: str, rig: str, camera: str, body: bytes, query: Any
) -> None:
    filled = path.format(rig=_quoted(rig), camera=_quoted(camera))
    headers = {"Content-Type": "application/json"}
    answer = operator.request(verb, filled, content=body, headers=headers, params=query)

    assert answer.status_code in EXPECTED, (answer.status_code, answer.text)
    if answer.status_code >= 400:
        problem = answer.json()
        assert re.fullmatch(r"[^\n]+[.:…]", problem["detail"]), problem
        assert problem["status"] == answer.status_code


def _quoted(text: str) -> str:
    """Write a name as a part of an address: dots alone would be taken for folders."""
    name = text.encode("utf-8", "replace")
    return "".join(f"%{byte:02X}" for byte in name) or "%20"
