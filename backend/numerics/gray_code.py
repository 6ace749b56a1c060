"""Decoding Gray code: which stripe each pixel sees, and how certain that is."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numba
import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64, Shaped, UInt16

from backend.numerics.errors import CodeError, FrameError
from backend.numerics.kernels import (
    frame_stack,
    kernel,
    narrow_part,
    new_work,
    row_loop,
    take_next,
    wide_part,
)
from backend.numerics.reasons import Reason

_TILE = 2048
_INVERSE, _WHITE_BLACK, _FIXED = 0, 1, 2
_CODE_MARGIN = np.int32(Reason.CODE_MARGIN)
_OUTSIDE = np.int32(Reason.OUTSIDE_PROJECTOR)
_SATURATED = np.int32(Reason.SATURATED)
_0, _1 = np.int32(0), np.int32(1)
_LARGEST = np.int32(0xFFFF)
_MAX_BITS = 16


class GrayCode(NamedTuple):
    """Which stripe of a Gray code each pixel sees."""

    code: Int32[np.ndarray, "h w"]
    """Number of the stripe, 0 at the pattern's beginning; -1 where `reasons` isn't 0."""
    projector_px: Float32[np.ndarray, "h w"]
    """Projector coordinate of the stripe's middle, pixel centres at integers; NaN where invalid."""
    contrast_gray: UInt16[np.ndarray, "h w"]
    """Contrast of the weakest bit that was judged, |pattern - inverse| in [gray]; 65535 if none was."""
    reasons: UInt16[np.ndarray, "h w"]
    """Why a pixel is invalid: bits of `Reason`, 0 where it is valid."""


def decode_gray_code(
    patterns: Sequence[Shaped[np.ndarray, "h w"]],
    inverses: Sequence[Shaped[np.ndarray, "h w"]],
    *,
    codes: int,
    size_px: int,
    min_contrast_gray: float = 5.0,
    ignored_low_bits: int = 0,
    unjudged_low_bits: int = 0,
    spared_bits: int = 0,
    saturation_gray: float = float("inf"),
    out: GrayCode | None = None,
) -> GrayCode:
    r"""Decode a Gray code of which each bit was shown with its inverse.

    Parameters
    ----------
    patterns, inverses
        The frames from the coarsest bit to the finest, uint8 or uint16, each its own array.
    codes
        Codes over the projector's width: often its columns, for which not every bit pattern occurs.
    size_px
        Projector's width (or height) in [px].
    min_contrast_gray
        A bit is 1 where pattern - inverse is more than this, 0 where it is less than minus this,
        and unknown between; in [gray].
    ignored_low_bits
        Finest bits that aren't read because the optics don't resolve them: 2**n codes become one.
    unjudged_low_bits
        Finest of the bits read whose contrast isn't judged: where the optics don't resolve them the
        code is 2**n stripes uncertain instead of invalid.
    spared_bits
        1: the weakest bit of each pixel isn't judged. On the border of two codes exactly one bit changes, so
        there it must be uncertain, and the code is one of the two all the same. 0: all bits are judged.
    saturation_gray
        A pixel is saturated where pattern and inverse of one bit both reach this gray level.
    out
        Maps to write to, an earlier result: touching new memory costs more than decoding.

    Raises
    ------
    FrameError
        If the frames don't fit together.
    CodeError
        If the codes need more bits, or no bit is left to read.

    Notes
    -----
    The bit is 1 if :math:`I - I' > \delta`, 0 if :math:`I - I' < -\delta` [1]_: free of any
    assumption about reflectance and ambient light. Cost: every frame is read once.

    References
    ----------
    .. [1] The "robust surface coding" method, equation 2, see the method's page.
    """
    bits = len(patterns)
    if len(inverses) != bits:
        raise FrameError(
            f"{bits} patterns but {len(inverses)} inverses were given: give both of every bit"
        )
    reading = _reading(bits, codes, ignored_low_bits, unjudged_low_bits)
    if spared_bits not in (0, 1):
        raise CodeError(
            f"{spared_bits} bits can't be spared: at the border of codes it is one, give 0 or 1"
        )
    frames = [*patterns[: reading.read], *inverses[: reading.read]]
    return _decode(
        frames,
        reading,
        _INVERSE,
        codes,
        size_px,
        min_contrast_gray,
        saturation_gray,
        spared_bits=spared_bits,
        out=out,
    )


def decode_gray_code_by_reference(
    patterns: Sequence[Shaped[np.ndarray, "h w"]],
    *,
    white: Shaped[np.ndarray, "h w"],
    black: Shaped[np.ndarray, "h w"],
    codes: int,
    size_px: int,
    min_contrast_gray: float = 5.0,
    ignored_low_bits: int = 0,
    unjudged_low_bits: int = 0,
    saturation_gray: float = float("inf"),
) -> GrayCode:
    r"""Decode a Gray code against pictures of the white and the black field.

    Parameters
    ----------
    patterns
        The frames from the coarsest bit to the finest, uint8 or uint16.
    white, black
        Pictures of the white and the black field at the same exposure.
    codes, size_px, ignored_low_bits, unjudged_low_bits
        As in `decode_gray_code`.
    min_contrast_gray
        A bit is unknown where :math:`|2 I - (I_w + I_b)|` isn't more than this, in [gray]; it
        compares with the contrast of pattern and inverse.
    saturation_gray
        A pixel is saturated where the white field reaches this gray level.

    Raises
    ------
    FrameError
        If the frames don't fit together.
    CodeError
        If the codes need more bits, or no bit is left to read.
    """
    reading = _reading(len(patterns), codes, ignored_low_bits, unjudged_low_bits)
    frames = [*patterns[: reading.read], white, black]
    return _decode(
        frames, reading, _WHITE_BLACK, codes, size_px, min_contrast_gray, saturation_gray
    )


def decode_gray_code_by_threshold(
    patterns: Sequence[Shaped[np.ndarray, "h w"]],
    *,
    threshold_gray: float,
    codes: int,
    size_px: int,
    min_contrast_gray: float = 0.0,
    ignored_low_bits: int = 0,
    unjudged_low_bits: int = 0,
) -> GrayCode:
    """Decode a Gray code with one threshold for the whole picture: naive, kept for comparison.

    A bit is 1 above `threshold_gray`, as in equation 1 of the "robust surface coding" method; it is
    unknown where twice the distance from the threshold is less than `min_contrast_gray`, in [gray].
    For everything else see `decode_gray_code`.
    """
    reading = _reading(len(patterns), codes, ignored_low_bits, unjudged_low_bits)
    return _decode(
        list(patterns[: reading.read]),
        reading,
        _FIXED,
        codes,
        size_px,
        min_contrast_gray,
        float("inf"),
        double_threshold_gray=int(np.floor(2 * threshold_gray)),
    )


class _Reading(NamedTuple):
    """How many of the bits are read, how many of these are judged, and how many are left out."""

    read: int
    judged: int
    left_out: int


def _reading(bits: int, codes: int, ignored_low_bits: int, unjudged_low_bits: int) -> _Reading:
    if bits > _MAX_BITS:
        raise CodeError(f"a code of {bits} bits is too long: give at most {_MAX_BITS} bits")
    if codes < 1 or codes > 2**bits:
        raise CodeError(
            f"{codes} codes don't fit into {bits} bits: give 1 to {2**bits} codes or the missing frames"
        )
    if not 0 <= ignored_low_bits < bits:
        raise CodeError(
            f"ignoring {ignored_low_bits} of {bits} bits leaves none to read: ignore 0 to {bits - 1}"
        )
    read = bits - ignored_low_bits
    if not 0 <= unjudged_low_bits < read:
        raise CodeError(
            f"leaving {unjudged_low_bits} of {read} bits unjudged leaves none to judge: "
            f"leave 0 to {read - 1}"
        )
    return _Reading(read, read - unjudged_low_bits, ignored_low_bits)


def _decode(
    frames: Sequence[Shaped[np.ndarray, "h w"]],
    reading: _Reading,
    mode: int,
    codes: int,
    size_px: int,
    min_contrast_gray: float,
    saturation_gray: float,
    double_threshold_gray: int = 0,
    spared_bits: int = 0,
    out: GrayCode | None = None,
) -> GrayCode:
    stack = frame_stack(frames)
    if out is not None and out.code.shape != stack.shape:
        raise FrameError(
            f"maps of shape {out.code.shape} can't take pictures of {stack.shape}: "
            "give maps of this size"
        )
    result = out or GrayCode(
        code=np.empty(stack.shape, np.int32),
        projector_px=np.empty(stack.shape, np.float32),
        contrast_gray=np.empty(stack.shape, np.uint16),
        reasons=np.empty(stack.shape, np.uint16),
    )
    _decode_gray(
        new_work(),
        stack.addresses,
        stack.wide,
        result.code.size,
        reading.read,
        mode,
        _Decision(
            judged=reading.judged,
            min_contrast=int(np.floor(min_contrast_gray)),
            double_threshold=double_threshold_gray,
            saturation=int(min(np.ceil(saturation_gray), 2**30)),
            shift=reading.left_out,
            codes=codes,
            pixels_per_code=size_px / codes,
            spared=spared_bits,
        ),
        _Maps(*(plane.reshape(-1) for plane in result)),
    )
    return result


class _Decision(NamedTuple):
    judged: int
    min_contrast: int
    double_threshold: int
    saturation: int
    shift: int
    codes: int
    pixels_per_code: float
    spared: int


class _Maps(NamedTuple):
    code: Any
    projector_px: Any
    contrast_gray: Any
    reasons: Any


@row_loop
def _fill(row: Any, value: Any) -> None:
    for i in range(row.size):
        row[i] = value


@row_loop
def _read_bit(pattern: Any, inverse: Any, binary: Any, code: Any, contrast: Any) -> None:
    """Append one bit: Gray to binary is a running exclusive or from the coarsest bit on."""
    for i in range(code.size):
        p, q = np.uint16(pattern[i]), np.uint16(inverse[i])
        bit = np.uint16(binary[i] ^ (np.uint16(1) if p > q else np.uint16(0)))
        binary[i] = bit
        code[i] = np.uint16((code[i] << np.uint16(1)) | bit)
        strength = np.uint16(p - q) if p > q else np.uint16(q - p)
        old = contrast[i]
        contrast[i] = strength if strength < old else old


@row_loop
def _keep_second(pattern: Any, inverse: Any, contrast: Any, second: Any) -> None:
    """Keep the contrast of the weakest bit but one; called before `contrast` takes the new bit in."""
    for i in range(second.size):
        p, q = np.uint16(pattern[i]), np.uint16(inverse[i])
        strength = np.uint16(p - q) if p > q else np.uint16(q - p)
        weakest, old = contrast[i], second[i]
        larger = strength if strength > weakest else weakest
        second[i] = larger if larger < old else old


@row_loop
def _read_bit_against(pattern: Any, reference: Any, binary: Any, code: Any, contrast: Any) -> None:
    """Append one bit that is 1 where twice the gray level is more than the reference."""
    for i in range(code.size):
        difference = (np.int32(pattern[i]) << _1) - reference[i]
        bit = np.uint16(binary[i] ^ (np.uint16(1) if difference > _0 else np.uint16(0)))
        binary[i] = bit
        code[i] = np.uint16((code[i] << np.uint16(1)) | bit)
        strength = np.int32(abs(difference))
        strength = strength if strength < _LARGEST else _LARGEST
        old = np.int32(contrast[i])
        contrast[i] = np.uint16(strength if strength < old else old)


@row_loop
def _keep_both_bright(pattern: Any, inverse: Any, brightest: Any) -> None:
    for i in range(brightest.size):
        p, q = np.uint16(pattern[i]), np.uint16(inverse[i])
        lower = p if p < q else q
        old = brightest[i]
        brightest[i] = lower if lower > old else old


@row_loop
def _add_to_reference(frame: Any, reference: Any) -> None:
    for i in range(reference.size):
        reference[i] += np.int32(frame[i])


@row_loop
def _store(
    code: Any,
    contrast: Any,
    brightest: Any,
    decision: Any,
    code_out: Any,
    projector_px: Any,
    contrast_out: Any,
    reasons_out: Any,
) -> None:
    min_contrast, saturation = np.int32(decision.min_contrast), np.int32(decision.saturation)
    shift, codes = np.int32(decision.shift), np.int32(decision.codes)
    pixels_per_code = np.float32(decision.pixels_per_code)
    half = np.float32(0.5 * (1 << decision.shift))
    for i in range(code.size):
        first = np.int32(code[i]) << shift
        reason = _CODE_MARGIN if np.int32(contrast[i]) <= min_contrast else _0
        reason = reason | (_SATURATED if np.int32(brightest[i]) >= saturation else _0)
        outside = _OUTSIDE if first >= codes else _0
        reason = reason if reason != _0 else outside
        code_out[i] = first if reason == _0 else np.int32(-1)
        middle = (np.float32(first) + half) * pixels_per_code - np.float32(0.5)
        projector_px[i] = middle if reason == _0 else np.float32(np.nan)
        contrast_out[i] = contrast[i]
        reasons_out[i] = np.uint16(reason)


class _Rows(NamedTuple):
    """One thread's intermediate rows, one value per pixel of a tile."""

    binary: Any  # uint16: the last bit of the code
    code: Any  # uint16
    contrast: Any  # uint16: of the weakest bit
    unjudged: Any  # uint16: takes the contrast of bits that aren't judged
    second: Any  # uint16: of the weakest bit but one
    brightest: Any  # uint16: darker one of pattern and inverse, at its brightest
    reference: Any  # int32: twice the gray level between black and white


@row_loop
def _read_inverse(
    addresses: Any, wide: Any, start: Any, n: Any, bits: Any, decision: Any, rows: Any
) -> None:
    """Read all bits of one tile, each against its inverse."""
    binary, code, brightest = rows.binary[:n], rows.code[:n], rows.brightest[:n]
    for bit in range(bits):
        weakest = rows.contrast[:n] if bit < decision.judged else rows.unjudged[:n]
        first, second = addresses[bit], addresses[bits + bit]
        if wide:
            p, q = wide_part(first, start, n), wide_part(second, start, n)
            if decision.spared and bit < decision.judged:
                _keep_second(p, q, weakest, rows.second[:n])
            _read_bit(p, q, binary, code, weakest)
            if decision.saturation <= _LARGEST:
                _keep_both_bright(p, q, brightest)
        else:
            a, b = narrow_part(first, start, n), narrow_part(second, start, n)
            if decision.spared and bit < decision.judged:
                _keep_second(a, b, weakest, rows.second[:n])
            _read_bit(a, b, binary, code, weakest)
            if decision.saturation <= _LARGEST:
                _keep_both_bright(a, b, brightest)


@row_loop
def _read_against(
    addresses: Any, wide: Any, start: Any, n: Any, bits: Any, decision: Any, rows: Any
) -> None:
    """Read all bits of one tile against the white and the black field, or a threshold."""
    binary, code, reference = rows.binary[:n], rows.code[:n], rows.reference[:n]
    _fill(reference, np.int32(decision.double_threshold))
    for field in range(bits, addresses.size):
        if wide:
            _add_to_reference(wide_part(addresses[field], start, n), reference)
        else:
            _add_to_reference(narrow_part(addresses[field], start, n), reference)
        if field == bits:
            _keep_both_bright(reference, reference, rows.brightest[:n])
    for bit in range(bits):
        weakest = rows.contrast[:n] if bit < decision.judged else rows.unjudged[:n]
        if wide:
            pattern = wide_part(addresses[bit], start, n)
            _read_bit_against(pattern, reference, binary, code, weakest)
        else:
            narrow = narrow_part(addresses[bit], start, n)
            _read_bit_against(narrow, reference, binary, code, weakest)


@row_loop
def _decode_share(
    counter: Any,
    addresses: Any,
    wide: Any,
    n_px: Any,
    bits: Any,
    mode: Any,
    decision: Any,
    maps: Any,
) -> None:
    rows = _Rows(
        np.empty(_TILE, np.uint16),
        np.empty(_TILE, np.uint16),
        np.empty(_TILE, np.uint16),
        np.empty(_TILE, np.uint16),
        np.empty(_TILE, np.uint16),
        np.empty(_TILE, np.uint16),
        np.empty(_TILE, np.int32),
    )
    start = _TILE * take_next(counter)
    while start < n_px:
        n = min(_TILE, n_px - start)
        end = start + n
        _fill(rows.binary, 0)
        _fill(rows.code, 0)
        _fill(rows.contrast, 0xFFFF)
        _fill(rows.second, 0xFFFF)
        _fill(rows.brightest, 0)
        if mode == _INVERSE:
            _read_inverse(addresses, wide, start, n, bits, decision, rows)
        else:
            _read_against(addresses, wide, start, n, bits, decision, rows)
        _store(
            rows.code[:n],
            rows.second[:n] if decision.spared else rows.contrast[:n],
            rows.brightest[:n],
            decision,
            maps.code[start:end],
            maps.projector_px[start:end],
            maps.contrast_gray[start:end],
            maps.reasons[start:end],
        )
        start = _TILE * take_next(counter)


@kernel
def _decode_gray(
    work: Any, addresses: Any, wide: Any, n_px: Any, bits: Any, mode: Any, decision: Any, maps: Any
) -> None:
    for _ in numba.prange(work.n_threads):
        _decode_share(work.counter, addresses, wide, n_px, bits, mode, decision, maps)


class DistinctPixels(NamedTuple):
    """Projector pixels that were seen, each with the camera pixels that see it."""

    projector_px: Int32[np.ndarray, "n 2"]
    """Column and row of each projector pixel, sorted by row, then column."""
    camera_px: Float64[np.ndarray, "n 2"]
    """Mean position x, y of the camera pixels that see it, in [px]."""
    n_camera_px: Int64[np.ndarray, "n"]
    """How many camera pixels see it, >= 1."""
    spread_px: Float64[np.ndarray, "n"]
    """Root mean square distance of these camera pixels from their mean, in [px]: a large one means
    that separate places carry the same code, which no surface can do."""


def distinct_projector_pixels(
    columns: Int32[np.ndarray, "h w"],
    rows: Int32[np.ndarray, "h w"],
    *,
    width_px: int,
    height_px: int,
) -> DistinctPixels:
    """Average the camera pixels that see the same projector pixel.

    Parameters
    ----------
    columns, rows
        Projector column and row that each camera pixel sees; negative where unknown.
    width_px, height_px
        Size of the projector.

    Raises
    ------
    CodeError
        If a column or row isn't on the projector.

    Notes
    -----
    Cost: a few passes over the valid pixels; memory: five numbers per projector pixel.

    Examples
    --------
    >>> columns = np.array([[3, 3, -1]], dtype=np.int32)
    >>> seen = distinct_projector_pixels(columns, np.zeros_like(columns), width_px=8, height_px=1)
    >>> seen.camera_px, seen.n_camera_px
    (array([[0.5, 0. ]]), array([2]))
    """
    valid = (columns >= 0) & (rows >= 0)
    if (columns[valid] >= width_px).any() or (rows[valid] >= height_px).any():
        raise CodeError(
            f"codes up to column {int(columns.max())}, row {int(rows.max())} aren't on a projector of "
            f"{width_px} x {height_px} px: give the projector's size"
        )
    camera_y, camera_x = np.nonzero(valid)
    index = rows[valid].astype(np.int64) * width_px + columns[valid]
    count = np.bincount(index, minlength=width_px * height_px)
    seen = np.flatnonzero(count)
    count = count[seen]
    x, y = (np.bincount(index, weights=place)[seen] / count for place in (camera_x, camera_y))
    # From the mean, not as a difference of squares: positions are thousands, spreads a pixel.
    position = np.searchsorted(seen, index)
    squares = (camera_x - x[position]) ** 2 + (camera_y - y[position]) ** 2
    spread_px = np.sqrt(np.bincount(position, weights=squares, minlength=len(seen)) / count)
    return DistinctPixels(
        projector_px=np.stack([seen % width_px, seen // width_px], axis=1).astype(np.int32),
        camera_px=np.stack([x, y], axis=1),
        n_camera_px=count,
        spread_px=spread_px,
    )


def warm_up_kernels() -> None:
    """Compile this module's kernels, see `warm_up`."""
    frame = np.zeros((1, 1), np.uint8)
    decode_gray_code([frame], [frame], codes=2, size_px=2)
