"""Results as documents and back."""

import enum
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from jaxtyping import Bool, Float, UInt8, UInt16
from pydantic import BaseModel, ConfigDict

from backend.domain.errors import CorruptDataError, NotFoundError
from backend.domain.frames import Frame, InMemory, Pixels
from backend.domain.hashing import canonical_json
from backend.domain.hints import Frames, Histogram, Mask, Picture, Table, Value
from backend.domain.patterns import BLACK, WHITE, Gray, Pattern, Sine, StaticPicture, Stripe
from backend.domain.rig import CameraFacts, PinholeModel, Pose, RigCalibration, RigFacts
from backend.domain.states import Level, Review
from backend.storage.artifacts import LocalArtifactStore, StoredPixels
from backend.storage.codec import content_hash, decode, encode, references


class Reason(enum.IntFlag):
    DARK = 1
    SATURATED = 2


class Fit(NamedTuple):
    values: Float[np.ndarray, "n"]
    rms_gray: float


@dataclass(frozen=True)
class Zone:
    peak_gray: float
    level: Level
    count: int = 0


class Options(BaseModel):
    model_config = ConfigDict(frozen=True)

    steps: int = 4
    names: tuple[str, ...] = ()


texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=5)
keys = texts.filter(lambda text: not text.startswith("$"))
numbers = st.floats(width=64)
maps = hnp.arrays(np.float32, (2, 3), elements=st.floats(width=32))
grays = hnp.arrays(np.uint8, (2, 3))
patterns = st.one_of(
    st.just(WHITE),
    st.just(StaticPicture()),
    st.builds(Sine, periods=st.floats(0.1, 99), shift_rad=st.floats(-7, 7)),
    st.builds(Gray, bit=st.integers(0, 8), bits=st.just(9), codes=st.just(512)),
    st.builds(Stripe, periods=st.floats(0.1, 99), inverse=st.booleans()),
)
frame_fields = st.fixed_dictionaries(
    {
        "camera": texts,
        "pattern": patterns,
        "exposure_ms": st.none() | st.floats(0.1, 1000),
        "pixels": grays.map(InMemory),
        "bit_depth": st.sampled_from([8, 12]),
        "gain_db": st.floats(0, 20),
        "role": texts,
    }
)
json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | numbers | texts,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(keys, inner, max_size=3),
    max_leaves=6,
)
zones = st.builds(Zone, numbers, st.sampled_from(Level), st.integers())

KINDS: dict[str, tuple[Any, st.SearchStrategy[Any]]] = {
    "map per camera": (
        Annotated[Mapping[str, Float[np.ndarray, "h w"]], Picture("Phase", unit="rad")],
        st.dictionaries(keys, maps, max_size=2),
    ),
    "mask": (
        Annotated[Bool[np.ndarray, "h w"], Mask("Valid", labels={0: "", 1: "valid"})],
        hnp.arrays(np.bool_, (2, 3)),
    ),
    "histogram": (
        Annotated[Float[np.ndarray, "gray"], Histogram("Histogram")],
        hnp.arrays(np.float64, st.integers(0, 4), elements=numbers),
    ),
    "bare array": (
        np.ndarray,
        hnp.arrays(
            st.sampled_from([np.int64, np.float32, np.uint16]), hnp.array_shapes(min_dims=0)
        ),
    ),
    "array of either type or none": (
        UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"] | None,
        st.none() | grays | hnp.arrays(np.uint16, (1, 2)),
    ),
    "table": (
        Annotated[tuple[Zone, ...], Table("Zones")],
        st.lists(zones, max_size=3).map(tuple),
    ),
    "fixed tuple": (tuple[int, float], st.tuples(st.integers(), numbers)),
    "named tuples": (
        Mapping[str, Fit],
        st.dictionaries(keys, st.builds(Fit, hnp.arrays(np.float32, 2), numbers), max_size=2),
    ),
    "frames": (
        Annotated[tuple[Frame, ...], Frames("Frames")],
        st.lists(frame_fields, max_size=3),
    ),
    "pixels": (Pixels | None, st.none() | maps.map(InMemory)),
    "pattern": (Pattern, patterns),
    "one of two models or none": (
        Sine | Gray | None,
        st.none() | patterns.filter(lambda p: isinstance(p, Sine | Gray)),
    ),
    "model": (
        Options,
        st.builds(Options, steps=st.integers(), names=st.lists(texts, max_size=2).map(tuple)),
    ),
    "enumeration": (Review, st.sampled_from(Review)),
    "flags": (Reason, st.sampled_from([Reason(0), Reason.DARK, Reason.DARK | Reason.SATURATED])),
    "literal": (Literal["fast", "full"], st.sampled_from(["fast", "full"])),
    "integer": (Annotated[int, Value("Count")], st.integers()),
    "truth": (bool, st.booleans()),
    "number": (float, numbers),
    "number or none": (float | None, st.none() | numbers),
    "text, integer or none": (str | int | None, st.none() | texts | st.integers()),
    "texts": (Sequence[str], st.lists(texts, max_size=2).map(tuple)),
    "list of numbers": (list[float], st.lists(numbers, max_size=2)),
    "numbers by name": (dict[str, float], st.dictionaries(keys, numbers, max_size=3)),
    "any JSON": (Any, json_values),
    "none": (None, st.none()),
}


@pytest.fixture(scope="module")
def shared_store(tmp_path_factory: pytest.TempPathFactory) -> LocalArtifactStore:
    return LocalArtifactStore(tmp_path_factory.mktemp("artifacts"), durable=False)


@pytest.mark.parametrize("kind", KINDS)
@given(data=st.data())
@settings(max_examples=25, deadline=None)
def test_a_result_comes_back_as_it_was(
    shared_store: LocalArtifactStore, kind: str, data: st.DataObject
) -> None:
    annotation, values = KINDS[kind]
    value = data.draw(values)
    if kind == "frames":  # made here: the checks of shapes use chance, which a strategy must not
        value = tuple(Frame(**fields) for fields in value)
    result_type, result = with_field(annotation, value)
    document = encode(result, shared_store)
    through_a_database = json.loads(json.dumps(document, allow_nan=False))
    back = decode(through_a_database, result_type, shared_store)
    assert_same(back.field, result.field)
    assert encode(result, shared_store) == document
    assert content_hash(encode(back, shared_store)) == content_hash(document)
    assert all(hash in shared_store for hash in references(document))


def with_field(annotation: Any, value: Any) -> tuple[type, Any]:
    """Return a result type with one field of that annotation, and a result."""
    kind: type = dataclass(frozen=True)(
        type("Result", (), {"__annotations__": {"field": annotation}})
    )
    return kind, kind(value)


def assert_same(back: Any, value: Any) -> None:
    """Compare deeply; NaN equals NaN, 0.0 isn't -0.0, mappings keep their order."""
    if isinstance(value, np.ndarray):
        assert (back.dtype, back.shape) == (value.dtype, value.shape)
        np.testing.assert_array_equal(
            back.view(np.uint8), value.view(np.uint8)
        ) if value.ndim else None
        assert back.tobytes() == value.tobytes()
    elif isinstance(value, Pixels):
        assert isinstance(back, StoredPixels)
        assert_same(back.load(), value.load())
    elif is_dataclass(value):
        for f in fields(value):
            assert_same(getattr(back, f.name), getattr(value, f.name))
    elif isinstance(value, Mapping):
        assert list(back) == list(value)
        assert_same(list(back.values()), list(value.values()))
    elif isinstance(value, list | tuple):
        assert type(back) is type(value)
        assert len(back) == len(value)
        for one, other in zip(back, value, strict=True):
            assert_same(one, other)
    else:
        assert (type(back), repr(back)) == (type(value), repr(value))


# --- what stands in a document -------------------------------------------------------------------------


@dataclass(frozen=True)
class Small:
    """A result with one array and one frame."""

    gray: UInt8[np.ndarray, "n"]
    frame: Frame
    rms_gray: float = math.nan


def small(store: LocalArtifactStore) -> tuple[Small, dict[str, Any]]:
    gray = np.arange(4, dtype=np.uint8)
    frame = Frame("left", BLACK, 60.0, InMemory(gray.reshape(2, 2)), role="dark")
    result = Small(gray, frame)
    return result, encode(result, store)


def test_a_document_is_what_the_contract_says(store: LocalArtifactStore) -> None:
    _, document = small(store)
    line, square = references(document)
    assert document == {
        "gray": {"$array": line, "shape": [4], "dtype": "|u1"},
        "frame": {
            "$frame": {
                "camera": "left",
                "pattern": {"kind": "uniform", "gray": 0.0},
                "exposure_ms": 60.0,
                "bit_depth": 8,
                "gain_db": 0.0,
                "role": "dark",
                "image": {"$array": square, "shape": [2, 2], "dtype": "|u1"},
            }
        },
        "rms_gray": {"$float": "nan"},
    }
    canonical_json(document)
    assert store.meta(square).shape == (2, 2)


def test_numbers_are_those_of_the_annotation_whatever_numpy_made_of_them(
    store: LocalArtifactStore,
) -> None:
    zone = Zone(np.float32(1.5), Level.OK, np.int64(3))  # type: ignore[arg-type]  # that is the case
    assert encode(zone, store) == {"peak_gray": 1.5, "level": "ok", "count": 3}
    whole = encode(Zone(2, Level.OK), store)
    assert canonical_json(whole) == canonical_json(encode(Zone(2.0, Level.OK), store))


def test_equal_arrays_under_different_names_are_stored_once(store: LocalArtifactStore) -> None:
    @dataclass(frozen=True)
    class Twice:
        first: np.ndarray
        second: Mapping[str, np.ndarray]

    array = np.random.default_rng(1).random((100, 100))
    document = encode(Twice(array, {"left": array.copy(), "right": array.T.copy().T}), store)
    assert len(set(references(document))) == 1
    assert len(list(store.hashes())) == 1


def test_frames_in_the_store_are_neither_read_nor_written(
    store: LocalArtifactStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    result, document = small(store)
    back = decode(document, Small, store)

    def refuse(*_: object) -> None:
        raise AssertionError("it read or wrote")

    with monkeypatch.context() as patch:
        patch.setattr(StoredPixels, "load", refuse)
        patch.setattr(Path, "replace", refuse)
        assert encode(back, store) == document
    np.testing.assert_array_equal(back.frame.gray, result.frame.gray)


def test_frames_of_another_store_are_copied(store: LocalArtifactStore, tmp_path: Path) -> None:
    _, document = small(store)
    other = LocalArtifactStore(tmp_path / "other", durable=False)
    assert encode(decode(document, Small, store), other) == document
    assert set(other.hashes()) == set(references(document))


def test_facts_and_calibration_of_a_rig_come_back(store: LocalArtifactStore) -> None:
    camera = CameraFacts(1280, 960, 8, 0.1, 500.0, 4.0, 15_300.0, 12.0)
    facts = RigFacts({"left": camera, "right": camera}, "left")
    assert decode(encode(facts, store), RigFacts, store) == facts
    model = PinholeModel(1280, 960, np.diag([2400.0, 2400.0, 1.0]))
    calibration = RigCalibration({"left": model}, {"left": Pose(np.eye(3), np.zeros(3))}, "left")
    assert_same(decode(encode(calibration, store), RigCalibration, store), calibration)


# --- what is refused -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("annotation", "value", "sentence"),
    [
        (bytes, b"", r"Result.field is annotated .*bytes.*can't be stored"),
        (Path, Path(), "can't be stored"),
        (set[str], {"a"}, "can't be stored"),
        (int | Zone, 3, "can't be stored"),
        (object, 3, "can't be stored"),
        (complex, 1j, "can't be stored"),
        (Mapping[int, str], {1: "a"}, r"Result.field has to be a mapping whose keys are texts"),
        (dict[str, float], {"$array": 1.0}, "don't start with a dollar sign"),
        (int, 1.5, r"Result.field has to be int, not 1.5"),
        (int, True, "has to be int"),
        (bool, 1, "has to be bool"),
        (float, "1", "has to be float"),
        (float, None, "has to be float"),
        (float, True, "has to be float"),
        (str, 1, "has to be str"),
        (str, Level.OK, "annotate it with its enumeration"),
        (Level, "ok", "has to be Level"),
        (np.ndarray, [1, 2], "has to be a numpy array"),
        (np.ndarray, np.array(["a"]), r"Result.field: an array of <U1 can't be stored"),
        (Zone, Fit(np.zeros(1), 0.0), "has to be Zone"),
        (tuple[Zone, ...], (Zone(1, Level.OK), 3), r"Result.field\[1\] has to be Zone"),
        (Mapping[str, Zone], {"left": 3}, r"Result.field\['left'\] has to be Zone"),
        (tuple[int, int], (1,), "has to be a tuple of 2"),
        (Frame, np.zeros(2), "has to be a frame"),
        (Pixels, np.zeros(2), "has to be pixels"),
        (Options, {"steps": 4}, "has to be a pydantic model"),
        (Sine | Gray, WHITE, "which its annotation doesn't allow"),
        (None, 1, "has to be None"),
        (Any, {"a": {1}}, r"Result.field\['a'\]"),
        (Any, {1: 2}, "keys are texts"),
    ],
)
def test_what_cannot_be_stored_is_refused_with_the_name_of_its_field(
    store: LocalArtifactStore, annotation: Any, value: Any, sentence: str
) -> None:
    _, result = with_field(annotation, value)
    with pytest.raises(TypeError, match=sentence):
        encode(result, store)


@pytest.mark.parametrize("value", [3, "text", None, {"a": 1}, [1]])
def test_only_a_dataclass_is_a_result(store: LocalArtifactStore, value: Any) -> None:
    with pytest.raises(TypeError, match="can't be"):
        encode(value, store)


DAMAGED: dict[str, tuple[dict[str, Any], str]] = {
    "nothing": ({}, "Small lacks frame, gray"),
    "no array": ({"gray": 3}, "Small.gray can't be 3"),
    "no hash": ({"gray": {"$array": 3}}, "Small.gray"),
    "no frame": ({"frame": {"camera": "left"}}, "Small.frame can't be"),
    "an empty frame": ({"frame": {"$frame": {}}}, "Small.frame can't be"),
    "no shape": ({"frame": {"$frame": {"image": {"$array": "0" * 64}}}}, "Small.frame"),
    "no type": (
        {"frame": {"$frame": {"image": {"$array": "0" * 64, "shape": [2], "dtype": "?!"}}}},
        "Small.frame",
    ),
    "another number": ({"rms_gray": {"$float": "many"}}, "Small.rms_gray"),
    "text for number": ({"rms_gray": "1.0"}, "Small.rms_gray can't be '1.0'"),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_a_document_that_does_not_fit_is_one_sentence(store: LocalArtifactStore, case: str) -> None:
    _, document = small(store)
    changes, sentence = DAMAGED[case]
    damaged = {**document, **changes} if changes else {}
    with pytest.raises(CorruptDataError, match=sentence) as caught:
        decode(damaged, Small, store)
    assert "run its stage again" in caught.value.sentence


@pytest.mark.parametrize(
    ("annotation", "value"),
    [
        (Level, "splendid"),
        (Zone, 3),
        (tuple[int, int], [1]),
        (tuple[int, ...], 3),
        (Frame, {"$frame": {}}),
        (Mapping[str, int], [1]),
        (Pattern, {"kind": "spiral"}),
        (int, 1.5),
        (int, True),
        (str, 1),
        (None, 1),
        (Literal["fast"], {"a": 1}),
    ],
)
def test_a_value_that_does_not_fit_names_its_field(
    store: LocalArtifactStore, annotation: Any, value: Any
) -> None:
    kind, _ = with_field(annotation, value)
    with pytest.raises(CorruptDataError, match=r"Result\.field"):
        decode({"field": value}, kind, store)


def test_an_array_that_is_gone_is_named(store: LocalArtifactStore) -> None:
    _, document = small(store)
    store.delete(document["gray"]["$array"])
    with pytest.raises(NotFoundError, match=document["gray"]["$array"]):
        decode(document, Small, store)


def test_a_result_of_an_earlier_version_gets_defaults_and_loses_what_is_gone(
    store: LocalArtifactStore,
) -> None:
    document = {"peak_gray": 1.0, "level": "ok", "width_gray": 3.0}
    assert decode(document, Zone, store) == Zone(1.0, Level.OK, count=0)


def test_a_field_made_by_the_class_itself_is_not_stored(store: LocalArtifactStore) -> None:
    @dataclass(frozen=True)
    class Derived:
        side_px: int
        area_px: int = field(init=False)

        def __post_init__(self) -> None:
            object.__setattr__(self, "area_px", self.side_px**2)

    document = encode(Derived(3), store)
    assert document == {"side_px": 3}
    assert decode(document, Derived, store) == Derived(3)
