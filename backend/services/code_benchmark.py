"""How long decoding a Gray code takes: 11 bits and inverses in both directions, beside copying its 44 frames."""

from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from backend.numerics.gray_code import GrayCode, decode_gray_code
from backend.numerics.patterns import Axis, gray_code_pattern

BITS = 11
FRAMES = 4 * BITS
_PROJECTOR_PX = (1280, 800)

Frames = list[UInt8[np.ndarray, "h w"]]


class _Code(NamedTuple):
    codes: int
    patterns: Frames
    inverses: Frames
    maps: GrayCode


class CodeScene:
    """A camera that sees the whole projector straight on, with noise."""

    def __init__(self, width_px: int, height_px: int) -> None:
        rng = np.random.default_rng(0)
        self._noise = rng.integers(0, 20, (height_px, width_px), dtype=np.uint8)
        self._codes = [self._code("x", width_px), self._code("y", height_px)]
        self._buffers = [np.empty_like(frame) for frame in self._frames]

    @property
    def _frames(self) -> Frames:
        return [f for code in self._codes for f in (*code.patterns, *code.inverses)]

    def _code(self, axis: Axis, size_px: int) -> _Code:
        codes = _PROJECTOR_PX[0 if axis == "x" else 1]
        seen = np.linspace(0, codes - 0.01, size_px).astype(np.int64)
        pair: tuple[Frames, Frames] = ([], [])
        for inverse in (False, True):
            for bit in reversed(range(BITS)):
                pattern = gray_code_pattern(
                    width_px=codes, height_px=1, bit=bit, bits=BITS, codes=codes, inverse=inverse
                )
                line = pattern[0][seen] // np.uint8(2)
                shape = (1, -1) if axis == "x" else (-1, 1)
                pair[inverse].append(np.asarray(self._noise + line.reshape(shape), np.uint8))
        maps = decode_gray_code(*pair, codes=codes, size_px=codes)
        return _Code(codes, *pair, maps)

    def copy(self) -> None:
        """Copy all frames."""
        for buffer, frame in zip(self._buffers, self._frames, strict=True):
            np.copyto(buffer, frame)

    def decode(self) -> None:
        """Decode both directions to code, coordinate, contrast and reasons."""
        for code in self._codes:
            decode_gray_code(
                code.patterns, code.inverses, codes=code.codes, size_px=code.codes, out=code.maps
            )
