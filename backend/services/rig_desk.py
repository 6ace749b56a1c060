"""Rigs without a scan: devices, live pictures, check, latency calibration, discovery.

Whatever touches a device is handed over to the rig's thread and looked at later: no call here waits for one.
"""

import time
from collections.abc import Mapping
from datetime import datetime
from typing import Any

import numpy as np

from backend.contract.rigs import (
    DeviceView,
    DiscoverCameras,
    Discovery,
    FoundCameraView,
    LatencyView,
    Limits,
    LiveCamera,
    LiveSettings,
    LiveView,
    RigLink,
    RigOffer,
    RigOwner,
    RigState,
    RigWork,
)
from backend.devices.discovery import ask_addresses, ask_known, search, why_silent
from backend.devices.found import FoundCamera
from backend.devices.protocols import CameraCapabilities, ProjectorCapabilities
from backend.domain.errors import ConflictError, InvalidSettingError, NotFoundError
from backend.jobs.control import JobControl
from backend.jobs.live import PATTERNS, LivePicture, LiveWish, refuse_pattern
from backend.jobs.rigs import KnownDevice, Owner, RigStatus
from backend.numerics.live_numbers import live_numbers
from backend.services.context import Context
from backend.services.latency import Latency, measure_latency
from backend.services.rig_trial import try_rig
from backend.services.rig_works import Found, RigWorks, Work
from backend.services.rigs import refuse_unknown

LATENCY, CHECK = "latency calibration", "check"


class RigDesk:
    """What an operator does with rigs before and between scans.

    Parameters
    ----------
    context
        Rigs, rig files, events.
    """

    def __init__(self, context: Context) -> None:
        self._context = context
        self._works = RigWorks(context.events.publish)
        self._settings: dict[str, LiveSettings] = {}
        self._numbers: dict[tuple[str, str], LiveCamera] = {}
        """Of the newest picture of each camera."""

    def close(self) -> None:
        """End the work that runs."""
        self._works.close()

    # ---- devices

    def state(self, rig: str) -> RigState:
        """Tell how a rig is doing.

        Raises
        ------
        NotFoundError
            If there is no such rig.
        """
        status, offer = self._context.rigs.status(rig), self._offer(rig)
        exposure_ms, gain_db = _limits(status)
        settle_ms = _settle_ms(status)
        kept = self._kept(rig)
        counts = (
            kept is not None and settle_ms is not None and np.isclose(kept.settle_ms, settle_ms)
        )
        return RigState(
            name=rig,
            title=offer.title if offer else rig,
            link=status.link,
            options=dict(status.options or {}),
            failure=status.failure or (offer.error if offer else None),
            owner=_owner(status.owner),
            devices=tuple(map(_device, status.devices)),
            exposure_ms=exposure_ms,
            gain_db=gain_db,
            period_ms=_period_ms(status),
            patterns=PATTERNS,
            live=self._in_force(rig, status),
            settle_ms=settle_ms,
            settle_measured=datetime.fromisoformat(kept.measured) if kept and counts else None,
            keeps_latency=self._has_file(rig),
            work=_work(self._works.of(rig)),
        )

    def connect(self, rig: str, options: Mapping[str, Any]) -> RigState:
        """Have a rig opened in the background; one that is open stays as it is.

        Raises
        ------
        NotFoundError
            If no rig has this name; `package.module:factory` is looked for in the background.
        """
        refuse_unknown(self._context, rig)
        self._context.rigs.connect(rig, options)
        return self.state(rig)

    def disconnect(self, rig: str) -> RigState:
        """Have its devices closed, so that another program can use them; RigBusyError while somebody captures."""
        self._offer(rig)
        self._context.rigs.disconnect(rig)
        return self.state(rig)

    def reconnect(self, rig: str) -> RigState:
        """Have it closed and opened again with its options; RigBusyError while somebody captures."""
        self._offer(rig)
        self._context.rigs.reconnect(rig)
        return self.state(rig)

    def discover(self, request: DiscoverCameras) -> Discovery:
        """Ask addresses for cameras, or search; a second or two."""
        cameras: tuple[FoundCamera, ...] = ()
        problems: tuple[str, ...] = ()
        shelf = self._context.shelf
        if request.addresses or not request.search:
            cameras = (
                ask_known(shelf, request.addresses) if shelf else ask_addresses(request.addresses)
            )
            answered = {camera.address for camera in cameras}
            problems = tuple(f"{why_silent(a)}." for a in request.addresses if a not in answered)
        if request.search:
            searched = search()
            known = {(c.driver, c.address, c.serial) for c in cameras}
            more = [c for c in searched.cameras if (c.driver, c.address, c.serial) not in known]
            cameras, problems = (*cameras, *more), (*problems, *searched.problems)
        return Discovery(cameras=tuple(map(_found, cameras)), problems=problems)

    # ---- live pictures

    def live(self, rig: str) -> LiveView:
        """Tell what the newest pictures say; asks for none."""
        status = self._context.rigs.status(rig)
        if status.options is None:
            self._offer(rig)  # refuses what isn't there
        cameras = [k.device.name for k in status.devices if _is_camera(k)]
        return LiveView(
            rig=rig,
            running=status.owner is not None or status.is_live,
            owner=_owner(status.owner),
            settings=self._in_force(rig, status),
            cameras=tuple(n for c in cameras if (n := self._numbers_of(rig, c, status))),
            failure=status.failure,
        )

    def watch(self, rig: str) -> LiveView:
        """Have pictures taken for the next seconds, unless somebody captures; tell what the newest ones say."""
        status = self._context.rigs.status(rig)
        if status.link is RigLink.OPEN and status.owner is None:
            if status.wish is None:
                self._context.rigs.wish(rig, _wish(self._in_force(rig, status)))
            self._context.rigs.watch(rig)
        return self.live(rig)

    def rest(self, rig: str) -> LiveView:
        """End live pictures now."""
        self._context.rigs.rest(rig)
        return self.live(rig)

    def set_live(self, rig: str, settings: LiveSettings) -> LiveView:
        """Set how live pictures are taken from now on.

        Raises
        ------
        ConflictError
            If the rig isn't connected, or somebody captures with it.
        InvalidSettingError
            If a value is out of what the cameras can do, or there is no such pattern.
        """
        self._offer(rig)
        self._context.rigs.refuse_busy(rig)
        status = self._context.rigs.status(rig)
        exposure_ms, gain_db = _limits(status)
        if exposure_ms is None or gain_db is None:
            raise ConflictError(f"Rig {rig!r} isn't connected: connect it first.")
        _refuse_beyond("Exposure", settings.exposure_ms, exposure_ms, "ms")
        _refuse_beyond("Gain", settings.gain_db, gain_db, "dB")
        refuse_pattern(settings.pattern, _projector(status).size)
        self._settings[rig] = _snapped(settings, exposure_ms, _period_ms(status))
        self._context.rigs.wish(rig, _wish(self._settings[rig]))
        return self.live(rig)

    # ---- work

    def start_latency(self, rig: str, repetitions: int, who: str) -> RigState:
        """Begin to measure the latency of its projector; the state tells how far it is, and what came of it.

        Raises
        ------
        ConflictError
            If somebody captures, or work runs already.
        """
        options = self._free(rig)

        def measure(control: JobControl) -> Found:
            found = measure_latency(
                self._context,
                rig,
                options,
                control.progress,
                repetitions=repetitions,
                who=who,
                control=control,
            )
            return Found(latency=self._keep(rig, found))

        self._works.start(rig, LATENCY, who, measure)
        return self.state(rig)

    def start_check(self, rig: str, who: str, options: Mapping[str, Any] | None = None) -> RigState:
        """Begin to check a rig: a white and a black frame of each camera, and what looks wrong.

        Parameters
        ----------
        rig
            Its name.
        who
            Who has it meanwhile.
        options
            Opened with these; None: with those that it has.

        Raises
        ------
        ConflictError
            If somebody captures, or work runs already.
        """
        known = self._free(rig)
        options = known if options is None else options

        def check(control: JobControl) -> Found:
            control.progress(0.1, "white and black frames")
            trial = try_rig(self._context, rig, options, who=who, control=control)
            lines = tuple(
                f"{f.camera}: white {f.mean_gray:.0f}, black {f.dark_mean_gray:.1f} gray at {f.exposure_ms:.1f} ms, "
                f"{f.saturated_share:.1%} saturated"
                for f in trial.frames
            )
            return Found(lines=(*lines, trial.calibration, *trial.notes), problems=trial.problems)

        self._works.start(rig, CHECK, who, check)
        return self.state(rig)

    def cancel(self, rig: str, who: str) -> RigState:
        """Have the running work ended; ConflictError if nothing runs."""
        self._offer(rig)
        self._works.cancel(rig, who)
        return self.state(rig)

    def latency(self, rig: str) -> LatencyView | None:
        """Return the latency measured last, else the one kept for the rig; None if there is neither."""
        self._offer(rig)
        work = self._works.of(rig)
        if work is not None and work.found.latency is not None:
            return work.found.latency
        kept = self._kept(rig)
        return _latency(kept, kept=True) if kept else None

    def _keep(self, rig: str, found: Latency) -> LatencyView:
        """Keep a latency for a rig that is described by a file, and let its projector wait so long from now on."""
        shelf = self._context.shelf
        if shelf is None or not self._has_file(rig):
            note = "Not kept: this rig has no rig file that it could be kept for."
            return _latency(found, kept=False, note=note)
        found.keep(shelf.folder, rig)
        self._context.rigs.reconnect(rig)
        return _latency(found, kept=True)

    def _free(self, rig: str) -> Mapping[str, Any]:
        """Return the options that a rig has, if nobody captures with it."""
        self._offer(rig)
        self._context.rigs.refuse_busy(rig)
        return self._context.rigs.status(rig).options or {}

    # ---- what is known

    def _offer(self, rig: str) -> RigOffer | None:
        """Return what is offered under a name; None: nothing, but it was opened as `package.module:factory`.

        Raises
        ------
        NotFoundError
            If there is neither.
        """
        offers = {offer.name: offer for offer in self._context.offers()}
        if rig not in offers and self._context.rigs.status(rig).options is None:
            raise NotFoundError(f"There is no rig {rig!r}; there are: {', '.join(offers)}.")
        return offers.get(rig)

    def _has_file(self, rig: str) -> bool:
        shelf = self._context.shelf
        return shelf is not None and rig in {kept.name for kept in shelf.kept()}

    def _kept(self, rig: str) -> Latency | None:
        shelf = self._context.shelf
        return Latency.kept(shelf.folder, rig) if shelf is not None else None

    def _in_force(self, rig: str, status: RigStatus) -> LiveSettings:
        """Return the live settings as the open rig can do them: another one of its name may have other limits."""
        settings = self._settings.get(rig, LiveSettings())
        exposure_ms, gain_db = _limits(status)
        if exposure_ms is None or gain_db is None:
            return settings
        within = settings.model_copy(
            update={
                "exposure_ms": min(max(settings.exposure_ms, exposure_ms.min), exposure_ms.max),
                "gain_db": min(max(settings.gain_db, gain_db.min), gain_db.max),
            }
        )
        return _snapped(within, exposure_ms, _period_ms(status))

    def _numbers_of(self, rig: str, camera: str, status: RigStatus) -> LiveCamera | None:
        picture = self._context.rigs.live(rig, camera)
        if picture is None:
            return None
        known = self._numbers.get((rig, camera))
        if known is None or known.number != picture.number:
            known = _numbers(camera, picture, self._black_level(rig, camera, status))
            self._numbers[rig, camera] = known
        return known.model_copy(update={"age_s": time.monotonic() - picture.taken_s})

    def _black_level(self, rig: str, camera: str, status: RigStatus) -> float:
        facts = status.facts.cameras if status.facts else {}
        return facts[camera].black_level_gray if camera in facts else 0.0


def _numbers(camera: str, picture: LivePicture, black_level_gray: float) -> LiveCamera:
    found = live_numbers(picture.gray, picture.bit_depth, black_level_gray=black_level_gray)
    height_px, width_px = picture.gray.shape
    return LiveCamera(
        camera=camera,
        number=picture.number,
        age_s=0.0,
        width_px=width_px,
        height_px=height_px,
        bit_depth=picture.bit_depth,
        exposure_ms=picture.exposure_ms,
        gain_db=picture.gain_db,
        histogram=tuple(found.histogram.tolist()),
        mean_gray=found.mean_gray,
        saturated_share=found.saturated_share,
        black_share=found.black_share,
        sharpness=found.sharpness,
    )


def _wish(settings: LiveSettings) -> LiveWish:
    return LiveWish(settings.exposure_ms, settings.gain_db, settings.pattern, settings.level)


def _snapped(settings: LiveSettings, limits: Limits, period_ms: float | None) -> LiveSettings:
    """Return settings with the nearest exposure of whole periods, where the cameras can do one."""
    if not settings.snap or period_ms is None:
        return settings
    lowest = max(1, int(np.ceil(limits.min / period_ms - 1e-9)))
    highest = int(np.floor(limits.max / period_ms + 1e-9))
    if highest < lowest:
        return settings
    periods = int(np.clip(round(settings.exposure_ms / period_ms), lowest, highest))
    return settings.model_copy(update={"exposure_ms": periods * period_ms})


def _refuse_beyond(what: str, value: float, limits: Limits, unit: str) -> None:
    slack = 1e-9 * max(1.0, abs(value))
    if not limits.min - slack <= value <= limits.max + slack:
        raise InvalidSettingError(
            f"{what} {value:g} {unit} can't be set: all cameras can do {limits.min:g} to {limits.max:g} {unit}."
        )


def _limits(status: RigStatus) -> tuple[Limits | None, Limits | None]:
    """Return what all cameras can do: exposure in [ms], gain in [dB]."""
    cans = [
        k.capabilities for k in status.devices if isinstance(k.capabilities, CameraCapabilities)
    ]
    if not cans:
        return None, None
    exposure_ms = Limits(
        min=max(c.exposure_us.min for c in cans) / 1000.0,
        max=min(c.exposure_us.max for c in cans) / 1000.0,
        step=max(c.exposure_us.inc for c in cans) / 1000.0,
    )
    gain_db = Limits(
        min=max(c.gain_db.min for c in cans),
        max=min(c.gain_db.max for c in cans),
        step=max(c.gain_db.inc for c in cans),
    )
    return exposure_ms, gain_db


def _projector(status: RigStatus) -> ProjectorCapabilities:
    for known in status.devices:
        if isinstance(known.capabilities, ProjectorCapabilities):
            return known.capabilities
    raise ConflictError("The rig isn't connected: connect it first.")


def _period_ms(status: RigStatus) -> float | None:
    if not status.devices:
        return None
    refresh_hz = _projector(status).refresh_hz
    return 1000.0 / refresh_hz if refresh_hz else None


def _settle_ms(status: RigStatus) -> float | None:
    for known in status.devices:
        if not _is_camera(known):
            settle_ms = getattr(known.device, "settle_ms", None)
            return float(settle_ms) if settle_ms is not None else None
    return None


def _is_camera(known: KnownDevice) -> bool:
    return isinstance(known.capabilities, CameraCapabilities)


def _device(known: KnownDevice) -> DeviceView:
    info, can = known.info, known.capabilities
    is_camera = isinstance(can, CameraCapabilities)
    width_px, height_px = can.sensor_size if isinstance(can, CameraCapabilities) else can.size
    return DeviceView(
        name=known.device.name,
        role="camera" if is_camera else "projector",
        vendor=info.vendor,
        model=info.model,
        serial=info.serial,
        address=info.address,
        driver=info.driver,
        firmware=info.firmware,
        link=known.link.value,
        width_px=width_px,
        height_px=height_px,
        refresh_hz=can.refresh_hz if isinstance(can, ProjectorCapabilities) else None,
    )


def _owner(owner: Owner | None) -> RigOwner | None:
    return RigOwner(who=owner.who, doing=owner.doing, scan=owner.scan) if owner else None


def _work(work: Work | None) -> RigWork | None:
    if work is None:
        return None
    return RigWork(
        kind=work.kind,
        status=work.status,
        who=work.who,
        progress=work.live.progress,
        text=work.live.text,
        error=work.error,
        latency=work.found.latency,
        lines=work.found.lines,
        problems=work.found.problems,
    )


def _latency(found: Latency, *, kept: bool, note: str = "") -> LatencyView:
    return LatencyView(
        settle_ms=found.settle_ms,
        refresh_hz=found.refresh_hz,
        exposure_ms=found.exposure_ms,
        delays_ms=found.delays_ms,
        up=found.up,
        down=found.down,
        measured=datetime.fromisoformat(found.measured),
        kept=kept,
        note=" ".join(filter(None, (note, _coarseness(found)))),
        resolution_ms=found.resolution_ms,
    )


def _coarseness(found: Latency) -> str:
    """Say what cameras that run freely can't tell."""
    if not found.by_free_run or found.resolution_ms is None:
        return ""
    return (
        f"Its cameras run freely: it may be up to {found.resolution_ms:.0f} ms longer than needed, and what their readout"
        " takes."
    )


def _found(camera: FoundCamera) -> FoundCameraView:
    return FoundCameraView(
        driver=camera.driver,
        rig_line=camera.rig_line,
        vendor=camera.vendor,
        model=camera.model,
        serial=camera.serial,
        address=camera.address,
        controlled_by=camera.controlled_by,
        used_in=camera.used_in,
    )
