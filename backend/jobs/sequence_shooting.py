"""Take whole bursts by the projector's own clock: its trigger output fires the cameras' lines.

A pattern is shown for exactly as long as the cameras expose, so it is complete in every frame whatever its bit planes
are; between two patterns there is time for the cameras to read out.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import groupby

from backend.devices.errors import FeatureError
from backend.devices.protocols import (
    Camera,
    Frame,
    Rig,
    SequenceProjector,
    TriggerSource,
    Wired,
)
from backend.jobs.control import JobControl
from backend.jobs.device_threads import DeviceThreads, aside
from backend.jobs.frame_order import check_sequence
from backend.jobs.shooting import FRAME_TIMEOUT_S, Shooter, Take, disarm, settings_of

_DARK_S = 0.0003
"""Between two patterns, beside the readout: projectors need a little, and so do jittering edges."""


def shooter_of(rig: Rig, control: JobControl, threads: DeviceThreads | None = None) -> Shooter:
    """Choose how shots are taken on a rig: by its projector's clock where everything is wired for it."""
    lines = rig.trigger_lines if isinstance(rig, Wired) else {}
    projector = rig.projector
    if lines and isinstance(projector, SequenceProjector) and projector.capabilities.sequence:
        return SequenceShooter(rig, projector, dict(lines), control, threads)
    return Shooter(rig, control, threads)


class SequenceShooter(Shooter):
    """Hardware-timed shots: consecutive ones of equal exposure, gain and cameras make one sequence.

    Shots of cameras that aren't wired are taken one by one, as are pictures that somebody waits for.
    """

    def __init__(
        self,
        rig: Rig,
        projector: SequenceProjector,
        lines: dict[str, TriggerSource],
        control: JobControl,
        threads: DeviceThreads | None = None,
    ) -> None:
        super().__init__(rig, control, threads)
        self._projector = projector
        self._lines = lines

    @property
    def way_out(self) -> str:
        """What helps if frames don't show what they were taken for."""
        return "check the trigger lines, their delay and the sequence that the projector holds"

    def off_grid(self, cameras: Sequence[str], exposure_ms: float) -> str:
        """Say nothing where all cameras are wired: a pattern is complete within their exposure, whatever that is."""
        wired = set(cameras) <= set(self._lines)
        return "" if wired else super().off_grid(cameras, exposure_ms)

    def chunks(self, takes: Sequence[Take]) -> Iterator[Sequence[Take]]:
        """Cut exposures into sequences."""
        most = max(1, self._projector.capabilities.max_sequence)
        for _, group in groupby(takes, key=lambda t: (t.exposure_ms, t.gain_db, t.cameras)):
            run = list(group)
            size = most if set(run[0].cameras) <= set(self._lines) else 1
            for first in range(0, len(run), size):
                yield run[first : first + size]

    def take_all(self, takes: Sequence[Take]) -> list[dict[str, Frame]]:
        """Run one sequence, again if a frame is missing or out of order."""
        cameras = takes[0].cameras
        if not set(cameras) <= set(self._lines):
            return super().take_all(takes)
        taken = self._persistently(cameras, lambda: self._sequence(takes))
        return [{name: taken[name][n] for name in cameras} for n in range(len(takes))]

    def _sequence(self, takes: Sequence[Take]) -> dict[str, list[Frame]]:
        cameras, exposure_us = takes[0].cameras, round(takes[0].exposure_ms * 1000.0, 3)
        period_us = self._period_us(cameras, exposure_us)
        with self._waiting():
            try:
                self._each(cameras, "arming", lambda camera: self._arm_on_line(camera, takes))
                # As the cameras took it: rounded up it would outlast the pattern.
                shown_us = max(self._rig.cameras[n].settings.exposure_us for n in cameras)
                self._ask_projector(
                    "preparing a sequence",
                    lambda: self._projector.arm_sequence(
                        [take.index for take in takes],
                        max(exposure_us, shown_us),
                        period_us + max(0.0, shown_us - exposure_us),
                    ),
                )
                frames = self._run(cameras, len(takes), period_us)
            finally:
                aside(self._projector.stop_sequence)
            self._each(cameras, "disarming", disarm)
        if len(takes) > 1:
            check_sequence(frames, (period_us + max(0.0, shown_us - exposure_us)) * 1e-6)
        return frames

    def _period_us(self, cameras: Sequence[str], exposure_us: float) -> float:
        """Return the time from pattern to pattern: every camera can read out before the next edge."""
        readout_s = max(self._rig.cameras[n].capabilities.min_frame_period_s for n in cameras)
        return exposure_us + 1e6 * (readout_s + _DARK_S)

    def _arm_on_line(self, camera: Camera, takes: Sequence[Take]) -> None:
        """Arm with buffers for the whole sequence: nobody fetches as fast as edges come."""
        line = self._lines[camera.name]
        if line not in camera.capabilities.trigger_sources:
            known = ", ".join(camera.capabilities.trigger_sources)
            raise FeatureError(
                camera.name,
                f"the rig file says that it is wired to {line}, but it has {known}; correct the file",
            )
        disarm(camera)
        settings = settings_of(takes[0].exposure_ms, takes[0].gain_db)
        camera.configure(replace(settings, trigger=line))
        self._asked.pop(camera.name, None)
        self._order.forget(camera.name)
        camera.arm(len(takes))

    def _run(self, cameras: Sequence[str], count: int, period_us: float) -> dict[str, list[Frame]]:
        """Start the sequence and collect its frames, every camera on its own thread."""
        timeout_s = FRAME_TIMEOUT_S + period_us * 1e-6
        name = self._projector.name

        def work(device: str) -> list[Frame]:
            if device == name:
                self._projector.start_sequence()
                return []
            camera = self._rig.cameras[device]
            return [camera.get_frame(timeout_s) for _ in range(count)]

        wait_s = count * period_us * 1e-6 + timeout_s
        found = self._threads.each(
            [*cameras, name], "running a sequence", work, control=self._control, wait_s=wait_s
        )
        return {camera: found[camera] for camera in cameras}

    def _abort(self) -> None:
        aside(self._projector.stop_sequence)
        super()._abort()
