"""Keys: what changes a result changes the key, and nothing else does."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from backend.domain.hashing import document_hash, stage_key

BASE: dict[str, Any] = {
    "stage": "zones",
    "version": 1,
    "settings": {"sigma_gray": 3.5, "gap_gray": 8.0},
    "inputs": {"preview": "ab", "mask": None},
    "capture": None,
}


@pytest.mark.parametrize(
    "change",
    [
        {"stage": "exposures"},
        {"version": 2},
        {"settings": {"sigma_gray": 3.6, "gap_gray": 8.0}},
        {"inputs": {"preview": "cd", "mask": None}},
        {"inputs": {"preview": "ab", "mask": "ef"}},
        {"capture": "scan/zones/1"},
    ],
)
def test_each_part_of_the_identity_counts(change):
    assert stage_key(**(BASE | change)) != stage_key(**BASE)


def test_the_order_of_settings_does_not_count():
    turned = BASE | {"settings": {"gap_gray": 8.0, "sigma_gray": 3.5}}
    assert stage_key(**turned) == stage_key(**BASE)


documents = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=8,
)


@given(documents, documents)
def test_equal_documents_hash_alike_and_others_do_not(a, b):
    same = a == b and repr(a) == repr(b)
    if same:
        assert document_hash(a) == document_hash(b)
    elif a != b:
        assert document_hash(a) != document_hash(b)


def test_not_a_number_is_refused():
    with pytest.raises(ValueError, match="Out of range"):
        document_hash({"x": float("nan")})
