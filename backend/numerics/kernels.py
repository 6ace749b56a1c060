"""How kernels are compiled here, and how they read frames that lie apart in memory.

Importing this module imports numba (0.3 s), so only modules with kernels import it.
"""

import hashlib
import inspect
import os
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, no_type_check

import numba
import numpy as np
from jaxtyping import Shaped, UInt
from numba.core import cgutils, types
from numba.core.caching import FunctionCache
from numba.extending import intrinsic

from backend.numerics.errors import FrameError

# The default layer may fall back to "workqueue", which aborts the process when two Python threads
# run parallel kernels at the same time; a station's server and its capture thread do that.
_CONFIG: Any = numba.config
_CONFIG.THREADING_LAYER = "omp"

# OpenMP's threads spin for milliseconds before and after each kernel, waiting for one another. On a
# station whose cores also capture, compress and serve, that multiplies a kernel's time by ten. It
# has to be set before the layer is loaded, which the first kernel does; an operator's choice wins.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# Everything of `fastmath` but nnan and ninf: with those LLVM deletes the tests for NaN, which
# means "invalid" in every map here.
FAST_MATH = {"nsz", "arcp", "contract", "afn", "reassoc"}

# What numba tells type checkers of itself changes from version to version and lacks options.
_NJIT: Any = numba.njit
_CACHE: Any = FunctionCache

Function = TypeVar("Function", bound=Callable[..., Any])


def kernel(function: Function) -> Function:
    """Compile a kernel lazily; its `prange` loops run on all threads, outside the GIL.

    Shape checks wrap every function in the tests; numba needs the bare one, and so does its cache:
    tests and product share one entry.
    """
    bare = inspect.unwrap(function)
    compiled: Any = _NJIT(parallel=True, nogil=True, error_model="numpy", fastmath=FAST_MATH)(bare)
    # Where `cache=True` puts numba's own cache.
    compiled._cache = _SourceCache(bare)  # noqa: SLF001 numba has no public way
    dispatcher: Function = compiled
    return dispatcher


class _SourceCache(_CACHE):  # type: ignore[misc]  # its base is Any, see above
    """Numba's cache on disk, which also notices changes in the row loops of other files.

    Numba compares a kernel's own file only, so an edited row loop in another one would go on
    running in its old form.
    """

    def _index_key(self, signature: Any, codegen: Any) -> tuple[Any, ...]:
        """Add the text of all files that the compiled code comes from."""
        files = sorted(set(_source_files(self._py_func, set())))
        return (*super()._index_key(signature, codegen), *map(_digest, files))


def _source_files(function: Any, seen: set[Any]) -> Iterator[str]:
    """List the files of a function and of all compiled functions that it calls."""
    yield function.__code__.co_filename
    for name in function.__code__.co_names:
        called = getattr(function.__globals__.get(name), "py_func", None)
        if called is not None and called not in seen:
            seen.add(called)
            yield from _source_files(called, seen)


@lru_cache
def _digest(file: str) -> str:
    return hashlib.sha256(Path(file).read_bytes()).hexdigest()


def row_loop(function: Function) -> Function:
    """Compile a loop over one-dimensional rows, for kernels to call.

    One plain loop per function and few arrays per loop: that is what LLVM vectorises. The same
    statements written straight into a parallel kernel run scalar, ten times slower. There is no
    wrapper for calls from Python, and no cache entry beside the kernel's: half the time to compile.
    """
    compiled: Function = _NJIT(
        error_model="numpy", fastmath=FAST_MATH, no_cpython_wrapper=True, no_cfunc_wrapper=True
    )(inspect.unwrap(function))
    return compiled


@no_type_check
@intrinsic
def _pointer(typingctx, address):  # noqa: ANN001, ANN202  numba takes the types from the call
    """Read an integer as the address of untyped memory."""

    def codegen(context, builder, signature, arguments):  # noqa: ANN001, ANN202  numba takes the types from the call
        return builder.inttoptr(arguments[0], cgutils.voidptr_t)

    return types.voidptr(types.uintp), codegen


class Work(NamedTuple):
    """The tiles that the threads of one call of a kernel share; `new_work` makes it."""

    counter: Any  # int64[1]: the next tile
    n_threads: int


def new_work() -> Work:
    """Prepare the sharing of one call's tiles between numba's threads.

    In Python, as a kernel that asks numba for its number of threads can't be cached.
    """
    return Work(np.zeros(1, np.int64), int(numba.get_num_threads()))


@no_type_check
@intrinsic
def take_next(typingctx, counter):  # noqa: ANN001, ANN201  numba takes the types from the call
    """Take the next number from the counter of a `Work`.

    numba gives each thread an equal share of a `prange`; when other programs keep one core busy the
    rest waits for that core. Threads that take small tiles one by one finish together:

        for _ in numba.prange(work.n_threads):
            share(work.counter, n, ...)  # tile = take_next(counter); while tile < n: ...
    """

    def codegen(context, builder, signature, arguments):  # noqa: ANN001, ANN202  numba takes the types from the call
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        one = context.get_constant(types.int64, 1)
        return builder.atomic_rmw("add", array.data, one, "monotonic")

    return types.int64(counter), codegen


@no_type_check
@numba.njit(inline="always")
def narrow_part(address, start, length):  # noqa: ANN001, ANN201  numba takes the types from the call
    """View `length` pixels from pixel `start` on of the uint8 frame at `address`."""
    return numba.carray(_pointer(np.uintp(address + start)), (length,), np.uint8)


@no_type_check
@numba.njit(inline="always")
def wide_part(address, start, length):  # noqa: ANN001, ANN201  numba takes the types from the call
    """View `length` pixels from pixel `start` on of the uint16 frame at `address`."""
    return numba.carray(_pointer(np.uintp(address + 2 * start)), (length,), np.uint16)


class FrameStack(NamedTuple):
    """Frames that lie apart in memory (memory-mapped files), as kernels take them."""

    addresses: UInt[np.ndarray, "n_frames"]
    """Address of each frame's first pixel."""
    wide: bool
    """The frames are uint16, not uint8. Kernels take this at run time: one compilation serves both."""
    shape: tuple[int, int]
    """Height and width of the frames."""
    frames: tuple[Shaped[np.ndarray, "h w"], ...]
    """The frames themselves, held as long as their addresses are in use."""


def frame_stack(frames: Sequence[Shaped[np.ndarray, "..."]]) -> FrameStack:
    """Collect the addresses of frames without copying them.

    Parameters
    ----------
    frames
        Pictures of one size, all uint8 or all uint16. A frame that isn't contiguous is copied.

    Returns
    -------
    FrameStack
        Valid as long as it is referenced.

    Raises
    ------
    FrameError
        If there is no frame, or sizes or types differ, or the type is another one.

    Notes
    -----
    Stacking twelve frames of five megapixels would cost more than decoding them. An array of
    addresses serves any number of frames with one compiled kernel; a tuple of arrays would need
    one per number.
    """
    if not frames:
        raise FrameError("no frame was given: at least one is needed")
    first = frames[0]
    if first.ndim != 2 or first.dtype not in (np.uint8, np.uint16):
        raise FrameError(
            f"frame 0 is {first.dtype} of shape {first.shape}: give height x width of uint8 or uint16"
        )
    for index, frame in enumerate(frames):
        if frame.shape != first.shape or frame.dtype != first.dtype:
            raise FrameError(
                f"frame {index} is {frame.dtype} of shape {frame.shape} but frame 0 is {first.dtype} "
                f"of shape {first.shape}: give frames of one camera in one size and bit depth"
            )
    held = tuple(np.require(frame, requirements=["C", "A"]) for frame in frames)
    addresses = np.array([frame.ctypes.data for frame in held], dtype=np.uintp)
    wide = first.dtype == np.uint16
    return FrameStack(addresses=addresses, wide=wide, shape=first.shape, frames=held)


class _Memory:
    """Memory of an array, described as writable; holds the array."""

    def __init__(self, array: Shaped[np.ndarray, "..."]) -> None:
        self.array = array
        self.__array_interface__ = {
            "data": (array.ctypes.data, False),
            "shape": array.shape,
            "typestr": array.dtype.str,
            "version": 3,
        }


def kernel_input(array: Shaped[np.ndarray, "..."]) -> Shaped[np.ndarray, "..."]:
    """View an array as kernels want their inputs: contiguous, aligned, and of the writable type.

    To numba a read-only array (a memory-mapped file) is another type than a writable one, and
    each type costs a compilation of seconds. Kernels never write to their inputs. An array that
    isn't contiguous is copied.
    """
    plain = np.require(array, requirements=["C", "A"])
    if plain.flags.writeable and type(plain) is np.ndarray:
        return plain
    # Memory of size 0 has no address worth describing.
    return np.asarray(_Memory(plain)) if plain.size else np.empty(plain.shape, plain.dtype)
