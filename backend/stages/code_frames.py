"""Captured Gray code: a result of its own, sorted into sets, and how imported frames become it."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated

from backend.domain.errors import InvalidCaptureError
from backend.domain.frames import Frame
from backend.domain.hints import Frames, Value
from backend.domain.patterns import Axis, Gray, Uniform


@dataclass(frozen=True)
class CodeFrames:
    """The captured code of all cameras, columns and rows."""

    frames: Annotated[tuple[Frame, ...], Frames("Captured code")]
    frame_count: Annotated[int, Value("Frames")]


@dataclass(frozen=True)
class CodeSet:
    """The Gray code of one camera along one direction."""

    camera: str
    axis: Axis
    codes: int
    """Stripes of the finest bit over the projector."""
    patterns: tuple[Frame, ...]
    """Coarsest bit first, all of them."""
    inverses: tuple[Frame, ...]
    """The same bits; empty where white and black tell the threshold."""
    white: Frame | None
    black: Frame | None

    @property
    def full_scale_gray(self) -> float:
        """The largest gray level."""
        return self.patterns[0].full_scale_gray


def import_code_frames(frames: tuple[Frame, ...]) -> CodeFrames:
    """Make the result of imported frames; refuses incomplete codes, passes over other patterns."""
    code_sets(frames)
    return CodeFrames(frames, len(frames))


def code_sets(frames: Iterable[Frame]) -> tuple[CodeSet, ...]:
    """Sort frames into the Gray codes they make up, camera by camera, columns before rows.

    Raises
    ------
    InvalidCaptureError
        If there is no Gray code, a bit is missing or there twice, neither inverses nor a white and a black
        field are complete, or frames of one set differ in size, bit depth or number of codes.
    """
    groups: dict[tuple[str, Axis], list[Frame]] = defaultdict(list)
    fields: dict[str, list[Frame]] = defaultdict(list)
    for frame in frames:
        if isinstance(frame.pattern, Gray):
            groups[frame.camera, frame.pattern.axis].append(frame)
        elif isinstance(frame.pattern, Uniform):
            fields[frame.camera].append(frame)
    if not groups:
        raise InvalidCaptureError(
            "The capture holds no Gray code: frames of kind 'gray' are needed."
        )
    return tuple(
        _code_set(camera, axis, groups[camera, axis], fields[camera])
        for camera, axis in sorted(groups)
    )


def _code_set(camera: str, axis: Axis, group: Sequence[Frame], fields: Sequence[Frame]) -> CodeSet:
    where = f"camera {camera!r}, axis {axis}"
    _alike("numbers of codes", {_gray(f).codes for f in group}, where)
    _alike("numbers of bits", {_gray(f).bits for f in group}, where)
    _alike("bit depths", {f.bit_depth for f in group}, where)
    _alike("sizes", {f.pixels.shape for f in group}, where)
    bits = _gray(group[0]).bits
    inverses = [f for f in group if _gray(f).inverse]
    white = max(fields, key=_field_gray, default=None)
    black = min(fields, key=_field_gray, default=None)
    has_fields = white is not None and black is not None and _field_gray(white) > _field_gray(black)
    if not inverses and not has_fields:
        raise InvalidCaptureError(
            f"The Gray code of {where} has neither inverse patterns nor a white and a black field: add one of them."
        )
    return CodeSet(
        camera=camera,
        axis=axis,
        codes=_gray(group[0]).codes,
        patterns=_complete([f for f in group if not _gray(f).inverse], bits, "patterns", where),
        inverses=_complete(inverses, bits, "inverse patterns", where) if inverses else (),
        white=white if has_fields else None,
        black=black if has_fields else None,
    )


def _complete(frames: Sequence[Frame], bits: int, what: str, where: str) -> tuple[Frame, ...]:
    found = [_gray(f).bit for f in frames]
    if missing := sorted(set(range(bits)) - set(found)):
        raise InvalidCaptureError(
            f"The {what} of {where} lack bits {missing} of {bits}: add their frames."
        )
    if twice := sorted({bit for bit in found if found.count(bit) > 1}):
        raise InvalidCaptureError(
            f"The {what} of {where} hold bits {twice} more than once: leave one frame of each."
        )
    return tuple(sorted(frames, key=lambda f: -_gray(f).bit))


def _alike(what: str, values: set[object], where: str) -> None:
    if len(values) > 1:
        raise InvalidCaptureError(
            f"The Gray code frames of {where} have different {what}: {sorted(map(str, values))}; capture them alike."
        )


def _gray(frame: Frame) -> Gray:
    assert isinstance(frame.pattern, Gray), "only Gray code frames are sorted here"
    return frame.pattern


def _field_gray(frame: Frame) -> float:
    assert isinstance(frame.pattern, Uniform), "only uniform fields are compared here"
    return frame.pattern.gray
