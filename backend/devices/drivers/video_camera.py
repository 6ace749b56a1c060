"""Webcams and other video devices (UVC, V4L2) through OpenCV: for demonstration.

Such a camera runs freely, exposes its rows one after the other (rolling shutter: a pattern that changes meanwhile
shows in a part of the picture), has a tone curve and 8 bits, and its exposure comes in steps of 100 us without
anybody having measured it. Whatever is set is read back; what the device doesn't take is refused.

A video file or a series of pictures (`picture_%03d.png`) is played instead of a device, over and over.
Run on files and on a device in memory; never on a real one.
"""

import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as NotYetError
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from jaxtyping import UInt8
from pydantic import Field

from backend.devices.drivers.library_camera import LibraryCamera
from backend.devices.errors import (
    DeviceError,
    DeviceNotFound,
    FeatureError,
    IncompleteFrame,
    UnsupportedFeature,
)
from backend.devices.found import FoundCamera
from backend.devices.options import DeviceOptions, Size, read_options, takes
from backend.devices.protocols import (
    CameraCapabilities,
    CameraSettings,
    DeviceInfo,
    Frame,
    Range,
    TriggerSource,
)
from backend.devices.refusals import fixed_exposure

_DEVICES = "/dev/video"
_SYSTEM = Path("/sys/class/video4linux")
_EXPOSURE_STEP_US = 100.0
"""V4L2 counts exposures in it."""
_MANUAL = 1.0
"""V4L2's exposure mode without automatic."""
_SHORTEST, _LONGEST = 1.0, 10_000.0
"""Asked for to learn the limits: a device takes the nearest it has. In steps."""
_BUFFERS = 4
"""OpenCV's queue of a V4L2 device."""
_CALL_S = 15.0
"""OpenCV gives a silent device 10 s."""
_FAREWELL_S = 1.0
_TOLERANCE = 1e-3

T = TypeVar("T")


class VideoOptions(DeviceOptions):
    """Which device or file, and how it is set."""

    source: int | str
    """Number of a video device (0 is /dev/video0), its path, a video file, or pictures as `picture_%03d.png`."""
    size: Size | None = None
    """Width and height in [px] to ask for; None: what the device is set to."""
    exposure_us: float | None = Field(None, gt=0)
    """Exposure in [us] of a device or file that takes none; else refused."""
    discard: int | None = Field(None, ge=0, le=100)
    """How many frames may wait in buffers; so many are thrown away after a pattern is lit. None: 4 of a device, 0
    of a file."""
    properties: dict[str, float] = {}
    """Other properties by OpenCV's names without CAP_PROP_, e.g. `{GAIN: 0, AUTO_WB: 0, FPS: 30}`."""


@takes(VideoOptions)
def create_camera(name: str, options: Mapping[str, Any]) -> "VideoCamera":
    """Make a camera of a rig file's entry."""
    return VideoCamera(name, read_options(VideoOptions, name, options))


class VideoCamera(LibraryCamera):
    """A `Camera` in free run. A thread of its own reads: a device that is stuck doesn't stop who waits for it.

    Parameters
    ----------
    name
        The camera's name in its rig.
    options
        Device and settings.
    open_capture
        Makes a capture of a source and one of OpenCV's backends; None: OpenCV does.
    """

    def __init__(
        self,
        name: str,
        options: VideoOptions,
        *,
        open_capture: Callable[[int | str, int], Any] | None = None,
    ) -> None:
        super().__init__(name, DeviceInfo("", "video", driver="video"))
        self._options = options
        self._open_capture = open_capture or _of_opencv
        self._capture: Any = None
        self._thread: ThreadPoolExecutor | None = None
        self._reading: Future[Any] | None = None
        self._to_drop = 0
        self._number = -1
        self._length = 0
        """Pictures in a file; 0: a device."""
        self._adjustable = False

    # ------------------------------------------------------------ life

    def _connect(self) -> tuple[DeviceInfo, CameraCapabilities, CameraSettings]:
        self._thread = ThreadPoolExecutor(1, thread_name_prefix=f"video-{self.name}")
        self._capture = self._opened()
        self._length = self._file_length()
        if self._options.size is not None:
            width_px, height_px = self._options.size
            self._set("FRAME_WIDTH", width_px)
            self._set("FRAME_HEIGHT", height_px)
        for name, value in self._options.properties.items():
            self._set(name, value)
        exposure_us = self._exposure_range()
        picture = self._look()
        height_px, width_px = picture.shape
        waiting = 0 if self._length else _BUFFERS
        can = CameraCapabilities(
            sensor_size=(width_px, height_px),
            pixel_formats=("Mono8",),
            exposure_us=exposure_us,
            gain_db=Range(0.0, 0.0, 0.0, "dB"),
            trigger_sources=(TriggerSource.FREE_RUN,),
            min_frame_period_s=self._period_s(),
            buffered_frames=waiting if self._options.discard is None else self._options.discard,
        )
        info = DeviceInfo("", f"video {self._options.source}", driver=f"opencv {cv2.__version__}")
        return info, can, self._read_settings(exposure_us)

    def _opened(self) -> Any:
        source, backend = self._place()
        with _quiet():
            capture = self._do(lambda: self._open_capture(source, backend))
        if not capture.isOpened():
            raise DeviceNotFound(
                self.name,
                f"video source {self._options.source} can't be opened; check that it exists, is a video and isn't in use",
            )
        return capture

    def _place(self) -> tuple[int | str, int]:
        """Return the source as OpenCV wants it, and which of its readers is meant."""
        source = self._options.source
        if isinstance(source, str) and source.isdecimal():
            source = int(source)
        if isinstance(source, int) or source.startswith(_DEVICES):
            return source, cv2.CAP_V4L2
        return source, cv2.CAP_IMAGES if "%" in source else cv2.CAP_FFMPEG

    def _file_length(self) -> int:
        _, backend = self._place()
        if backend == cv2.CAP_V4L2:
            return 0
        return max(1, round(self._get("FRAME_COUNT")))

    def _look(self) -> UInt8[np.ndarray, "h w"]:
        """Take one picture: only that tells the size for sure."""
        picture = self._do(self._read)
        if picture is None:
            raise DeviceNotFound(
                self.name, f"video source {self._options.source} delivers no picture; check it"
            )
        if picture.dtype != np.uint8:
            raise UnsupportedFeature(
                self.name, f"video source {self._options.source} has {picture.dtype} pictures; only 8 bits are read"
            )  # fmt: skip
        if self._length:
            self._do(lambda: self._capture.set(cv2.CAP_PROP_POS_FRAMES, 0))
        return _gray(picture)

    def _period_s(self) -> float:
        rate_hz = self._get("FPS")
        return 1.0 / rate_hz if rate_hz > 0 and not self._length else 0.0

    def _disconnect(self) -> None:
        """Let the reading thread give the device back; one that is stuck does so when it returns."""
        thread, capture = self._thread, self._capture
        self._thread = self._capture = self._reading = None
        if thread is None:
            return
        released = thread.submit(capture.release) if capture is not None else None
        thread.shutdown(wait=False)
        if released is not None:
            with suppress(NotYetError, cv2.error):
                released.result(_FAREWELL_S)

    # ------------------------------------------------------------ settings

    def _exposure_range(self) -> Range:
        """Switch the automatic off and learn what the device takes; a file takes nothing."""
        if self._length or not self._takes("AUTO_EXPOSURE", _MANUAL):
            return fixed_exposure(self.name, self._options.exposure_us)
        before = self._get("EXPOSURE")
        shortest, longest = self._nearest_exposure(_SHORTEST), self._nearest_exposure(_LONGEST)
        if not 0 < shortest < longest:
            return fixed_exposure(self.name, self._options.exposure_us)
        self._nearest_exposure(before)
        self._adjustable = True
        step_us = _EXPOSURE_STEP_US
        return Range(shortest * step_us, longest * step_us, step_us, "us")

    def _nearest_exposure(self, steps: float) -> float:
        self._do(lambda: self._capture.set(cv2.CAP_PROP_EXPOSURE, steps))
        return self._get("EXPOSURE")

    def _apply(self, wanted: CameraSettings) -> CameraSettings:
        if wanted.exposure_us != self._settings.exposure_us:
            before = self._get("EXPOSURE")
            try:
                self._set("EXPOSURE", round(wanted.exposure_us / _EXPOSURE_STEP_US))
            except FeatureError:
                self._nearest_exposure(before)  # it may have taken another one
                raise
            self._to_drop = self.capabilities.buffered_frames + 1
        return self._read_settings(self.capabilities.exposure_us)

    def _read_settings(self, exposure_us: Range) -> CameraSettings:
        now_us = self._get("EXPOSURE") * _EXPOSURE_STEP_US if self._adjustable else exposure_us.min
        return CameraSettings(now_us, pixel_format="Mono8", trigger=TriggerSource.FREE_RUN)

    def _set(self, name: str, value: float) -> None:
        if not hasattr(cv2, f"CAP_PROP_{name}"):
            raise FeatureError(
                self.name, f"OpenCV has no property {name}; leave it out or correct its name"
            )
        if not self._takes(name, value):
            raise FeatureError(
                self.name,
                f"{name} {value:g} isn't taken, the device says {self._get(name):g}; leave it out or choose another",
            )

    def _takes(self, name: str, value: float) -> bool:
        number = getattr(cv2, f"CAP_PROP_{name}")
        taken = self._do(lambda: self._capture.set(number, value))
        return bool(taken) and abs(self._get(name) - value) <= _TOLERANCE * max(1.0, abs(value))

    def _get(self, name: str) -> float:
        number = getattr(cv2, f"CAP_PROP_{name}")
        return float(self._do(lambda: self._capture.get(number)))

    def _do(self, work: Callable[[], T]) -> T:
        """Run something in the thread that reads: OpenCV's captures are for one thread."""
        assert self._thread is not None, "made by _connect"
        try:
            return self._thread.submit(work).result(_CALL_S)
        except NotYetError:
            raise self._lose(f"the device doesn't answer within {_CALL_S:g} s") from None

    # ------------------------------------------------------------ frames

    def _start(self, n_frames: int | None) -> None:
        """Let frames from before be thrown away: a device goes on while nobody asks."""
        del n_frames
        waiting = self.capabilities.buffered_frames if not self._length else 0
        self._to_drop = waiting + (self._reading is not None)

    def _stop(self) -> None:
        """Let the device go on, it can't be stopped; what it delivers is thrown away."""

    def _next(self, wait_s: float) -> Frame | None:
        assert self._thread is not None, "made by _connect"
        if self._reading is None:
            self._reading = self._thread.submit(self._read)
        try:
            picture = self._reading.result(wait_s)
        except NotYetError:
            return None
        self._reading = None
        if picture is None:
            raise self._lose("the device delivers no picture any more")
        self._number += 1
        if self._to_drop:
            self._to_drop -= 1
            return None
        gray = _gray(picture)
        if gray.shape[::-1] != self.capabilities.sensor_size:
            raise IncompleteFrame(
                self.name, f"frame {self._number} is {gray.shape[1]}x{gray.shape[0]}; take it again"
            )
        return self._told(gray, self._number, None, 8)

    def _read(self) -> Any:
        """Read the next picture, a file's first after its last; None where there is none."""
        capture = self._capture
        if self._length and capture.get(cv2.CAP_PROP_POS_FRAMES) >= self._length:
            capture.set(cv2.CAP_PROP_POS_FRAMES, 0)
        there, picture = capture.read()
        return picture if there else None

    def _translated(self, error: Exception, doing: str) -> DeviceError | None:
        if not isinstance(error, cv2.error):
            return None
        return FeatureError(self.name, f"refused {doing}: {' '.join(str(error).split())}; check it")


def _of_opencv(source: int | str, backend: int) -> Any:
    return cv2.VideoCapture(source, backend)


def _gray(picture: UInt8[np.ndarray, "..."]) -> UInt8[np.ndarray, "h w"]:
    """Return the luma of a colour picture, a gray one as it is."""
    if picture.ndim == 2:
        return picture
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), np.uint8)


_logging = threading.Lock()


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep OpenCV's own warnings off the error output: a source that isn't there is said in a sentence of ours."""
    levels = cv2.utils.logging
    with _logging:
        before = levels.setLogLevel(levels.LOG_LEVEL_SILENT)
        try:
            yield
        finally:
            levels.setLogLevel(before)


def search() -> tuple[FoundCamera, ...]:
    """Return the video devices of this computer; nothing is asked, the system knows them."""
    return tuple(
        FoundCamera("video", {"source": number}, model=model) for number, model in _listed(_SYSTEM)
    )


def _listed(system: Path) -> list[tuple[int, str]]:
    """Return number and model of what takes pictures; a device's further nodes hold data about them."""
    found = []
    for folder in sorted(system.glob("video*")):
        with suppress(OSError, ValueError):
            if int((folder / "index").read_text()) == 0:
                number = int(folder.name.removeprefix("video"))
                found.append((number, (folder / "name").read_text().strip()))
    return found


create_camera.search = search  # type: ignore[attr-defined]  # called by discovery
