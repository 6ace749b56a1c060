"""The state of a scan, field by field: what a screen gets without loading an array."""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import cv2
import numpy as np
import pytest
from jaxtyping import Float

from backend.contract.scans import FieldView, ScanState
from backend.domain.errors import ConflictError, NotFoundError, StageUnavailableError
from backend.domain.frames import Frame, InMemory
from backend.domain.hints import Curve, Frames, Mask, Mesh, Picture, Points, Table, Value
from backend.domain.patterns import WHITE
from backend.domain.rig import RigFacts
from backend.services.fields import field_views, point_count, small_value
from backend.storage.artifacts import LocalArtifactStore
from backend.storage.codec import encode
from tests.scans.toy_house import House, stage


@pytest.fixture
def state(house: House) -> ScanState:
    return house.run_through(house.create(note="for the test").id)


def field(state: ScanState, stage_name: str, name: str) -> FieldView:
    return next(f for f in stage(state, stage_name).fields if f.name == name)


def size_of(picture: bytes) -> tuple[int, ...]:
    decoded = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    return tuple(decoded.shape)


def test_the_head_of_a_state(house: House, state: ScanState) -> None:
    assert (state.name, state.note, state.method, state.rig, state.who) == (
        "part", "for the test", "toy", "toy", "ada",
    )  # fmt: skip
    assert state.job is not None
    assert (state.job.status, state.job.error, state.job.remaining_s) == ("finished", None, None)
    text = state.model_dump_json()
    assert ScanState.model_validate_json(text).model_dump_json() == text


def test_numbers_and_tables_are_in_the_state(state: ScanState) -> None:
    assert field(state, "toy_look", "exposure_ms").value == 8.0
    ladder = field(state, "toy_look", "ladder").value
    assert [set(rung) for rung in ladder] == [{"exposure_ms", "mean_gray"}] * 4


def test_arrays_are_references(house: House, state: ScanState) -> None:
    white = field(state, "toy_look", "white")
    assert white.per_camera
    assert set(white.arrays) == {"left", "right"}
    reference = white.arrays["left"]
    assert (reference.shape, reference.dtype) == ((16, 24), "|u1")
    assert house.services.artifact(reference.hash).shape == (16, 24)
    assert set(field(state, "toy_levels", "histogram").arrays) == {""}


def test_fields_that_a_hint_names_come_with_it(state: ScanState) -> None:
    """The axis of a curve, the borders in a histogram, the colours of points."""
    kinds = {s.name: {f.name: f.hint["kind"] for f in s.fields} for s in state.stages}
    assert kinds["toy_levels"] == {
        "histogram": "histogram", "count": "value", "labels": "mask", "levels_gray": "data",
    }  # fmt: skip
    assert kinds["toy_phase"]["x_px"] == "data"
    assert kinds["toy_cloud"] == {"points_mm": "points", "height_mm": "scalar", "rgb": "data"}


def test_frames_are_listed_with_how_they_were_taken(state: ScanState) -> None:
    frames = field(state, "toy_fringes", "frames").frames
    assert len(frames) == 2 * 4 * 2
    first = frames[0]
    assert (first.camera, first.exposure_ms, first.role, first.bit_depth) == (
        "left",
        2.0,
        "fringe",
        8,
    )
    assert first.pattern["kind"] == "sine"
    assert first.image.shape == (16, 24)


def test_a_stage_tells_its_checks_and_times(state: ScanState) -> None:
    look = stage(state, "toy_look")
    (check,) = look.checks
    assert (check.name, check.level, check.unit) == ("brightness", "ok", "gray")
    assert look.message == f"{check.sentence[:1].upper()}{check.sentence[1:]}."
    assert look.duration_s is not None
    assert look.duration_s >= 0
    assert look.started is not None
    assert stage(state, "toy_fringes").message.startswith("Done in ")


def test_a_pixel_a_picture_and_a_cloud_can_be_asked_for(house: House, state: ScanState) -> None:
    phase = field(state, "toy_phase", "phase_rad").arrays["left"]
    value = house.services.artifact_at(phase.hash, 3, 2)
    assert value == pytest.approx(float(house.services.artifact(phase.hash)[2, 3]))
    picture = house.services.artifact_preview(phase.hash, colormap="twilight")
    assert size_of(picture) == (16, 24, 3)
    assert house.services.artifact_preview(phase.hash, colormap="twilight") is picture, "remembered"
    run = stage(state, "toy_cloud").stage_run
    assert run
    cloud = house.services.cloud_preview(run, "points_mm", budget=100)
    assert len(cloud) > 100 * 12
    with pytest.raises(NotFoundError):
        house.services.artifact("0" * 64)
    with pytest.raises(NotFoundError, match="Look has no points 'white'"):
        house.services.cloud_preview(stage(state, "toy_look").stage_run or "", "white")


def test_a_failed_run_has_no_points(house: House) -> None:
    failed = house.run(house.create(settings={"toy_phase": {"behave": "sentence"}}).id)
    run = stage(failed, "toy_phase").stage_run
    assert run
    with pytest.raises(ConflictError, match="isn't finished"):
        house.services.cloud_preview(run, "phase_rad")


def test_methods_describe_themselves(house: House) -> None:
    (method,) = house.services.methods().methods
    assert [s.name for s in method.stages] == [
        s.name for s in house.services.context.registry.methods["toy"].stages
    ]
    assert method.stages[1].settings["properties"]["step_gray"]["unit"] == "gray"


# the rig of a scan


def test_a_scan_knows_its_rig(house: House, state: ScanState) -> None:
    view = house.services.scan_rig(state.id)
    assert (view.name, view.reference, [c.name for c in view.cameras]) == (
        "toy",
        "left",
        ["left", "right"],
    )
    assert view.cameras[0].model is not None
    assert view.projector is not None
    assert (view.projector.width_px, view.projector.model) == (32, None)
    assert house.services.rig("toy", {}) == view


def test_a_rig_without_calibration_has_no_models(house: House) -> None:
    view = house.services.rig("toy", {"calibrated": False})
    assert {c.model for c in view.cameras} == {None}


def test_what_was_never_asked_isnt_known(house: House) -> None:
    scan = house.create().id
    with house.shop.database.transaction() as repositories:
        row = repositories.scans.get(scan)
        repositories.scans.add(type(row)(**{**row.__dict__, "id": "bare"}))
    with pytest.raises(StageUnavailableError, match="knows nothing of its rig yet"):
        house.services.scan_rig("bare")
    assert RigFacts.__name__ == "RigFacts"


def test_the_live_picture_is_the_newest_frame(house: House, state: ScanState) -> None:
    picture = house.services.live_frame("toy", "left")
    assert picture is not None
    assert size_of(picture) == (16, 24, 3)
    assert house.services.live_frame("toy", "top") is None
    with pytest.raises(NotFoundError, match="no rig 'nowhere'"):
        house.services.live_frame("nowhere", "left")


# how long it takes


@dataclass(frozen=True)
class Row:
    name: str
    share: float


@dataclass(frozen=True)
class Rich:
    """One field of every kind."""

    number: Annotated[float, Value("Number")]
    nothing: Annotated[float | None, Value("Nothing")]
    rows: Annotated[tuple[Row, ...], Table("Rows")]
    by_name: Annotated[Mapping[str, float], Table("By name")]
    maps: Annotated[Mapping[str, Float[np.ndarray, "h w"]], Picture("Maps")]
    map: Annotated[Float[np.ndarray, "h w"] | None, Mask("Map")]
    y: Annotated[Float[np.ndarray, "n"], Curve("Curve", x="x")]
    x: Float[np.ndarray, "n"]
    frames: Annotated[Mapping[str, tuple[Frame, ...]], Frames("Frames")]
    points: Annotated[Float[np.ndarray, "n 3"], Points("Points")]
    mesh: Annotated[Float[np.ndarray, "n 3"], Mesh("Mesh", faces="faces")]
    faces: Float[np.ndarray, "m 3"]
    unseen: Float[np.ndarray, "n"]


def rich() -> Rich:
    line = np.arange(3.0)
    frame = Frame("left", WHITE, None, InMemory(np.zeros((2, 3), np.uint8)))
    points = np.zeros((5, 3))
    return Rich(
        float("nan"), None, (Row("a", 0.5), Row("b", float("inf"))), {"a": 1.0}, {"left": np.eye(2)}, None,
        line, line, {"left": (frame, frame)}, points, points, points, line,
    )  # fmt: skip


def test_every_kind_of_field_becomes_a_view(store: LocalArtifactStore) -> None:
    views = {v.name: v for v in field_views(Rich, encode(rich(), store))}
    assert "unseen" not in views
    assert (views["number"].value, views["nothing"].value) == (None, None), "NaN isn't JSON"
    assert views["rows"].value == [{"name": "a", "share": 0.5}, {"name": "b", "share": None}]
    assert (views["by_name"].value, views["by_name"].per_camera) == ({"a": 1.0}, False)
    assert set(views["maps"].arrays) == {"left"}
    assert (views["map"].arrays, views["map"].value) == ({}, None)
    assert [views[n].hint["kind"] for n in ("x", "faces")] == ["data", "data"]
    assert len(views["frames"].frames) == 2
    assert views["frames"].frames[0].exposure_ms is None
    for view in views.values():
        text = view.model_dump_json()
        assert FieldView.model_validate_json(text).model_dump_json() == text
    assert point_count(tuple(views.values())) == 5


def test_small_arrays_are_shown_large_ones_referred_to(store: LocalArtifactStore) -> None:
    small, large = np.array([1.0, 2.5]), np.zeros(1000)
    documents = [
        {"$array": store.put(a).hash, "shape": list(a.shape), "dtype": "<f8"}
        for a in (small, large)
    ]
    assert small_value(documents[0], store) == [1.0, 2.5]
    assert small_value(documents[1], store)["shape"] == [1000]
    assert small_value([1, {"$float": "nan"}], store) == [1, None]


@pytest.mark.bench
def test_a_state_with_hundreds_of_frames_is_quick(house: House) -> None:
    """Counted against the time of one query in the same process: a busy machine slows both."""
    settings: dict[str, Any] = {
        "toy_fringes": {"exposures_ms": [1.0, 2.0, 4.0, 8.0, 16.0, 32.0], "steps": 16}
    }
    state = house.run_through(house.create(settings=settings).id)
    assert len(field(state, "toy_fringes", "frames").frames) == 192
    best = min(_seconds(lambda: house.services.scan(state.id)) for _ in range(20))
    query = min(_seconds(lambda: house.services.audit(state.id)) for _ in range(20))
    assert best < 0.03 or best < 12 * query, f"{best * 1e3:.1f} ms, a query {query * 1e3:.1f} ms"


def _seconds(work: Any) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began
