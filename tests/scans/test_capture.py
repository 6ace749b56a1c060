"""Capture plans on the toy rig: journal, resume, re-shoot, cancel, waiting, what the devices are told."""

import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from backend.devices.errors import (
    DeviceDisconnected,
    DeviceError,
    DeviceTimeout,
    FeatureError,
    IncompleteFrame,
)
from backend.devices.protocols import CameraSettings, LinkState, TriggerSource
from backend.devices.protocols import Frame as DeviceFrame
from backend.domain.errors import (
    CancelledError,
    InvalidCaptureError,
    RigFailedError,
    StageFailedError,
    StorageFullError,
)
from backend.domain.frames import InMemory
from backend.domain.patterns import (
    BLACK,
    WHITE,
    Gray,
    Pattern,
    Sine,
    StaticPicture,
    Stripe,
    Uniform,
)
from backend.domain.shots import Exposed, OneOf, Plan, Shot, Until
from backend.jobs import shooting
from backend.jobs.capture import CaptureSession
from backend.jobs.control import JobControl, Live
from backend.jobs.journal import shot_hash
from backend.jobs.rendering import render
from backend.jobs.shooting import Shooter
from backend.storage.artifacts import LocalArtifactStore
from backend.storage.rows import FrameRow
from tests.scans.toy import (
    ABILITIES,
    Faults,
    FringesParams,
    ToyCamera,
    ToyRig,
    fringe_plan,
    wait_plan,
)


class MemoryJournal:
    """A journal without a database, that lives from session to session."""

    def __init__(self) -> None:
        self.rows: dict[tuple[str, int], FrameRow] = {}

    def find(self, shot: str, occurrence: int) -> FrameRow | None:
        return self.rows.get((shot, occurrence))

    def add(self, rows: Sequence[FrameRow]) -> None:
        for row in rows:
            assert (row.shot, row.occurrence) not in self.rows
            self.rows[row.shot, row.occurrence] = row

    def __len__(self) -> int:
        return len(self.rows)


class Bench:
    """A rig, a journal and a store; drives plans as a stage would."""

    def __init__(self, store: LocalArtifactStore, **options: Any) -> None:
        self.faults = Faults()
        self.rig = ToyRig("toy", options, self.faults)
        self.rig.open()
        self.store = store
        self.journal = MemoryJournal()
        self.told: list[Live] = []
        self.seen: list[tuple[str, bool]] = []
        self.control = JobControl(self.told.append, clock=iter(range(10_000)).__next__)

    def drive(self, *plans: Plan[Any], control: JobControl | None = None) -> list[Any]:
        with Shooter(self.rig, control or self.control) as shooter:
            session = self.session(shooter, control or self.control)
            return [session.run_plan(plan) for plan in plans]

    def replay(self, plan: Plan[Any]) -> Any:
        return self.session(None, JobControl()).run_plan(plan)

    def session(self, shooter: Shooter | None, control: JobControl) -> CaptureSession:
        return CaptureSession(
            scan="s", stage="toy_fringes", take=1, facts=self.rig.facts(), journal=self.journal,
            store=self.store, shooter=shooter, control=control, seen=self._look,
        )  # fmt: skip

    def _look(self, camera: str, frame: DeviceFrame, row: FrameRow | None) -> None:
        self.seen.append((camera, row is not None))


@pytest.fixture
def bench(store: LocalArtifactStore) -> Bench:
    return Bench(store)


def once(*shots: Shot) -> Plan[tuple[Exposed, ...]]:
    exposed = yield shots
    return exposed


FRINGES = FringesParams(exposures_ms=(2.0, 4.0), steps=4)


def test_a_burst_brings_a_frame_per_shot_and_camera(bench: Bench) -> None:
    (exposed,) = bench.drive(
        once(Shot(WHITE, 2.0, role="white"), Shot(BLACK, 1.0, cameras=("right",)))
    )
    assert [list(e) for e in exposed] == [["left", "right"], ["right"]]
    frame = exposed[0]["left"]
    assert (frame.camera, frame.pattern, frame.role, frame.bit_depth) == ("left", WHITE, "white", 8)
    assert frame.gray.max() > 40
    assert exposed[1]["right"].gray.max() == 0


def test_exposure_goes_to_the_camera_in_us_and_comes_back_as_it_was_taken(bench: Bench) -> None:
    (exposed,) = bench.drive(once(Shot(WHITE, 2.5, gain_db=3.0)))
    assert bench.rig.cameras["left"].settings.exposure_us == 2496.0, (
        "asked for 2500, rounded to 16 us"
    )
    assert exposed[0]["left"].exposure_ms == 2.496
    assert exposed[0]["left"].gain_db == 3.0
    row = next(iter(bench.journal.rows.values()))
    assert row.document["exposure_ms"] == 2.5
    assert row.metadata["exposure_us"] == 2496.0


def test_what_a_driver_tells_of_a_frame_is_kept_if_it_is_plain(bench: Bench) -> None:
    bench.drive(once(Shot(WHITE, 2.0)))
    row = next(iter(bench.journal.rows.values()))
    assert row.metadata == {
        "temperature": 30.5, "frame_id": 1, "exposure_us": 2000.0, "gain_db": 0.0, "pixel_format": "Mono8", "host_time_s": 1.0,
    }  # fmt: skip


def test_cameras_are_configured_only_when_the_exposure_changes(bench: Bench) -> None:
    bench.drive(fringe_plan(FRINGES))
    assert bench.rig.configured == 2 * 2, "two cameras, two exposures, eight shots"


def test_every_camera_has_one_thread(bench: Bench) -> None:
    bench.drive(fringe_plan(FRINGES))
    left, right = (camera.threads for camera in bench.rig.cameras.values())
    assert len(left) == len(right) == 1
    assert left != right


def test_patterns_are_rendered_and_loaded_once_for_all_exposures(bench: Bench) -> None:
    bench.drive(fringe_plan(FRINGES), once(Shot(Sine(periods=2, shift_rad=0.0), 8.0)))
    assert bench.rig.projector.loads == 1
    assert len(bench.rig.projector.loaded) == 4


def test_the_rig_is_left_dark_and_disarmed(bench: Bench) -> None:
    bench.drive(fringe_plan(FRINGES))
    assert bench.rig.projector.picture.max() == 0
    assert {camera.state for camera in bench.rig.cameras.values()} == {"ready"}


# the journal


def test_a_plan_driven_again_takes_no_shot(bench: Bench) -> None:
    (first,) = bench.drive(fringe_plan(FRINGES))
    shots = bench.rig.shots
    (again,) = bench.drive(fringe_plan(FRINGES))
    assert bench.rig.shots == shots == 8
    assert [f.pixels.hash for f in first] == [f.pixels.hash for f in again]


def test_a_plan_needs_no_rig_if_the_journal_has_everything(bench: Bench) -> None:
    (first,) = bench.drive(fringe_plan(FRINGES))
    again = bench.replay(fringe_plan(FRINGES))
    assert first == again
    longer = FringesParams(exposures_ms=(2.0, 8.0))
    with pytest.raises(InvalidCaptureError, match="lack fringe at 8 ms of toy_fringes"):
        bench.replay(fringe_plan(longer))


def test_only_what_changed_is_taken_again(bench: Bench) -> None:
    """Another exposure in the plan: its four shots are new, the four of the other exposure are known."""
    bench.drive(fringe_plan(FRINGES))
    bench.drive(fringe_plan(FringesParams(exposures_ms=(4.0, 8.0))))
    assert bench.rig.shots == 8 + 4


def test_a_camera_that_lacks_a_frame_is_the_only_one_to_take_it(bench: Bench) -> None:
    bench.drive(once(Shot(WHITE, 2.0, cameras=("left",))))
    frames = bench.rig.cameras["left"].frames
    bench.drive(once(Shot(WHITE, 2.0)))
    assert bench.rig.cameras["left"].frames == frames
    assert bench.rig.cameras["right"].frames == 1


def test_the_same_shot_twice_is_two_occurrences(bench: Bench) -> None:
    noisy = Bench(bench.store, noise=True)
    (first, second) = noisy.drive(once(Shot(WHITE, 2.0)), once(Shot(WHITE, 2.0)))
    assert noisy.rig.shots == 2
    (again, too) = noisy.drive(once(Shot(WHITE, 2.0)), once(Shot(WHITE, 2.0)))
    assert (first, second) == (again, too)
    assert first != second


CHANGES: list[dict[str, Any]] = [
    {"pattern": BLACK},
    {"exposure_ms": 2.5},
    {"gain_db": 1.0},
    {"mask": InMemory(np.ones((8, 32), np.float32))},
]


@pytest.mark.parametrize("change", CHANGES, ids=lambda c: next(iter(c)))
def test_whatever_was_asked_for_tells_shots_apart(bench: Bench, change: dict[str, Any]) -> None:
    shot = Shot(WHITE, 2.0)
    bench.drive(once(shot), once(replace(shot, **change)))
    assert bench.rig.shots == 2
    assert len({row.shot for row in bench.journal.rows.values()}) == 4, "two shots, two cameras"


def test_a_role_is_a_label_only() -> None:
    shot = Shot(WHITE, 2.0, role="white")
    assert shot_hash(shot, "left", None) == shot_hash(replace(shot, role="base"), "left", None)
    assert shot_hash(shot, "left", None) != shot_hash(shot, "right", None)


# what goes wrong


RETRYABLE = [
    DeviceTimeout("left", "no frame came"),
    IncompleteFrame("right", "3 packets are missing"),
]


@pytest.mark.parametrize("error", RETRYABLE, ids=lambda e: type(e).__name__)
def test_a_passing_failure_is_taken_again(bench: Bench, error: DeviceError) -> None:
    bench.faults.errors = {3: [error], 4: [error]}
    (frames,) = bench.drive(fringe_plan(FRINGES))
    assert len(frames) == 16
    assert bench.rig.shots == 8 + 2
    assert len(bench.journal) == 16


def test_a_lasting_failure_ends_the_capture_and_keeps_the_frames(bench: Bench) -> None:
    bench.faults.errors = {n: [DeviceTimeout("left", "no frame came")] for n in (3, 4, 5)}
    with pytest.raises(RigFailedError) as caught:
        bench.drive(fringe_plan(FRINGES))
    assert caught.value.sentence == (
        "left: no frame came; 4 captured frames are kept, mend it and run again to go on."
    )
    assert caught.value.details == {"device": "left"}
    assert bench.rig.shots == 5, "three tries of the third shot"
    bench.drive(fringe_plan(FRINGES))
    assert bench.rig.shots == 5 + 6, "the first two shots count"


def test_a_lost_device_is_fetched_back_and_the_shot_taken_again(bench: Bench) -> None:
    bench.faults.errors = {3: [DeviceDisconnected("right", "the link is gone")]}
    (frames,) = bench.drive(fringe_plan(FRINGES))
    assert len(frames) == 16
    assert bench.rig.shots == 8 + 1
    assert bench.rig.cameras["right"].reconnects == 1
    assert bench.rig.cameras["left"].reconnects == 0
    assert any("right is lost, waiting for it" in live.text for live in bench.told)


def test_a_camera_whose_loss_shows_when_it_is_disarmed_is_fetched_back(bench: Bench) -> None:
    """First no frame comes, then nothing answers any more."""
    bench.rig.cameras["right"] = VanishingCamera("right", bench.rig, LinkState.READY)
    (frames,) = bench.drive(fringe_plan(FRINGES))
    assert len(frames) == 16
    assert bench.rig.cameras["right"].reconnects == 1


class VanishingCamera(ToyCamera):
    """Its third frame never comes, its cable is out."""

    def get_frame(self, timeout_s: float = 2.0) -> DeviceFrame:
        if self.frames == 3 and not self.reconnects:
            raise DeviceTimeout(self.name, "no frame came")
        return super().get_frame(timeout_s)

    def configure(self, settings: CameraSettings) -> CameraSettings:
        self._refuse_lost()
        return super().configure(settings)

    def disarm(self) -> None:
        if self.frames == 3 and not self.reconnects:
            self.state = LinkState.LOST
        self._refuse_lost()
        super().disarm()

    def _refuse_lost(self) -> None:
        if self.state is LinkState.LOST:
            raise DeviceDisconnected(self.name, "the link is gone")


def test_a_lost_projector_gets_its_patterns_again(bench: Bench) -> None:
    bench.faults.errors = {3: [DeviceDisconnected("projector", "the page was closed")]}
    bench.faults.before_shot = bench.rig.projector.fail
    (frames,) = bench.drive(fringe_plan(FRINGES))
    assert len(frames) == 16
    assert bench.rig.projector.reconnects == 1
    assert bench.rig.projector.loads == 2


def test_a_device_that_doesnt_come_back_ends_the_capture_and_keeps_the_frames(
    bench: Bench, impatient: None
) -> None:
    bench.faults.gone = True
    bench.faults.errors = {3: [DeviceDisconnected("right", "the link is gone")]}
    with pytest.raises(RigFailedError, match="right: the link is gone for good; 4 captured frames"):
        bench.drive(fringe_plan(FRINGES))
    assert bench.rig.shots == 3
    bench.faults.gone = False
    bench.rig.open()
    bench.drive(fringe_plan(FRINGES))
    assert bench.rig.shots == 3 + 6, "the first two shots count"


def test_cancelled_while_a_lost_device_is_waited_for(bench: Bench) -> None:
    bench.faults.gone = True
    bench.faults.errors = {2: [DeviceDisconnected("right", "the link is gone")]}
    began = time.monotonic()
    threading.Timer(0.3, bench.control.stop, ("bob",)).start()
    with pytest.raises(CancelledError, match="Cancelled by bob"):
        bench.drive(fringe_plan(FRINGES))
    assert time.monotonic() - began < 0.75 * shooting.RECONNECT_S
    assert len(bench.journal) == 2


FREE = replace(ABILITIES, trigger_sources=(TriggerSource.FREE_RUN,), buffered_frames=2)


class FreeCamera(ToyCamera):
    """Runs freely: three frames after each new pattern still show the one before."""

    stale = 0
    shot = 0
    last: np.ndarray | None = None
    early: np.ndarray | None = None

    def configure(self, settings: CameraSettings) -> CameraSettings:
        assert settings.trigger is TriggerSource.FREE_RUN
        return super().configure(settings)

    def trigger(self) -> None:
        raise FeatureError(self.name, "runs freely")

    def get_frame(self, timeout_s: float = 2.0) -> DeviceFrame:
        self.frames += 1
        frame = super().get_frame(timeout_s)
        if self.rig.shots != self.shot:
            self.shot, self.stale, self.early = self.rig.shots, 3, self.last
        self.stale -= 1
        self.last = frame.data
        if self.stale < 0 or self.early is None:
            return frame
        return replace(frame, data=self.early)


def test_cameras_that_run_freely_throw_early_frames_away(bench: Bench) -> None:
    (expected,) = bench.drive(fringe_plan(FRINGES))
    free = Bench(bench.store)
    free.rig.cameras["left"] = FreeCamera("left", free.rig, capabilities=FREE)
    free.rig.open()
    (frames,) = free.drive(fringe_plan(FRINGES))
    for one, other in zip(frames, expected, strict=True):
        np.testing.assert_array_equal(one.gray, other.gray)
    assert free.rig.cameras["left"].frames == 8 * 4
    assert free.rig.shots == 8


def test_a_frame_that_comes_twice_is_taken_again(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = bench.rig.cameras["left"]

    def again(shot: int) -> None:
        if shot == 3:
            camera.frames -= 1

    bench.faults.before_shot = again
    (frames,) = bench.drive(fringe_plan(FRINGES))
    assert len(frames) == 16
    assert bench.rig.shots == 8 + 1


def test_cancelled_between_two_shots(bench: Bench) -> None:
    def cancel(shot: int) -> None:
        if shot == 3:
            bench.control.stop("bob")

    bench.faults.before_shot = cancel
    with pytest.raises(CancelledError, match="Cancelled by bob"):
        bench.drive(fringe_plan(FRINGES))
    assert bench.rig.shots <= 4
    assert bench.rig.projector.picture.max() == 0
    kept = len(bench.journal)
    bench.faults.before_shot = lambda shot: None
    (frames,) = bench.drive(fringe_plan(FRINGES), control=JobControl())
    assert len(frames) == 16
    assert len(bench.journal) == 16 > kept >= 4


def test_cancelled_while_a_frame_is_waited_for(bench: Bench) -> None:

    bench.faults.hold = threading.Event()
    bench.faults.before_shot = lambda shot: threading.Thread(
        target=bench.control.stop, args=("bob",)
    ).start()
    with pytest.raises(CancelledError):
        bench.drive(once(Shot(WHITE, 2.0)))
    assert len(bench.journal) == 0
    assert {camera.state for camera in bench.rig.cameras.values()} == {"ready"}


def test_a_full_disk_ends_the_capture(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(array: object) -> object:
        raise StorageFullError("There is no room.")

    monkeypatch.setattr(bench.store, "put", full)
    with pytest.raises(StorageFullError):
        bench.drive(fringe_plan(FRINGES))
    assert len(bench.journal) == 0
    assert bench.rig.shots <= 5, "it doesn't go on for long without writing"


def test_an_unknown_camera_is_named(bench: Bench) -> None:
    with pytest.raises(StageFailedError, match="asks for camera 'top', the rig has left, right"):
        bench.drive(once(Shot(WHITE, 1.0, cameras=("top",))))


def test_a_plan_may_clean_up(bench: Bench) -> None:
    closed = []

    def plan() -> Plan[None]:
        try:
            yield (Shot(WHITE, 1.0, cameras=("top",)),)
        finally:
            closed.append(True)

    with pytest.raises(StageFailedError):
        bench.drive(plan())
    assert closed == [True]


def test_an_empty_burst_and_an_empty_plan(bench: Bench) -> None:
    def nothing() -> Plan[str]:
        exposed = yield ()
        assert exposed == ()
        return "done"

    assert bench.drive(nothing()) == ["done"]


# waiting


def test_until_keeps_only_the_accepted_picture(bench: Bench) -> None:
    def brighter(shot: int) -> None:
        # Somebody opens the iris before the third picture.
        bench.rig.options["noise"] = False
        if shot == 3:
            bench.rig.seen_by = lambda camera: np.full((16, 24), 200, np.uint8)  # type: ignore[method-assign]  # on purpose

    bench.faults.before_shot = brighter
    (exposed,) = bench.drive(wait_plan("left"))
    assert exposed["left"].gray.min() == 200
    assert len(bench.journal) == 2
    assert bench.seen == [("left", False), ("right", False)] * 2 + [("left", True), ("right", True)]
    bench.drive(wait_plan("left"))
    assert bench.rig.shots == 3, "the journal answers"


def test_until_gives_up(bench: Bench) -> None:
    clock = iter(np.arange(0.0, 100.0, 0.75)).__next__
    with Shooter(bench.rig, bench.control) as shooter:
        session = bench.session(shooter, bench.control)
        session.clock = lambda: float(clock())
        with pytest.raises(StageFailedError, match="waited 2 s for a usable picture and none came"):
            session.run_plan(wait_plan("left"))
    assert bench.rig.shots == 3
    assert len(bench.journal) == 0


def test_until_can_be_cancelled(bench: Bench) -> None:
    bench.faults.before_shot = lambda shot: bench.control.stop("bob") if shot == 5 else None
    plan = wait_plan("left")
    with pytest.raises(CancelledError):
        bench.drive(plan)
    assert isinstance(Until(Shot(WHITE, 1.0), lambda e: True), Until)


# progress


def test_progress_tells_shot_share_and_remaining_time(bench: Bench) -> None:
    with Shooter(bench.rig, bench.control) as shooter:
        session = bench.session(shooter, bench.control)
        seconds = iter(np.arange(0.0, 1000.0, 1.0))
        session.clock = lambda: float(next(seconds))
        session.run_plan(fringe_plan(FRINGES))
    told = [live for live in bench.told if live.text.startswith("fringe")]
    assert [live.text for live in told][:2] == ["fringe at 2 ms, 1 of 8", "fringe at 2 ms, 2 of 8"]
    assert [live.progress for live in told] == [n / 8 for n in range(8)]
    assert told[0].remaining_s is None
    # One second passes per shot on this clock: seven are left after the first.
    assert told[1].remaining_s == pytest.approx(7.0, abs=0.05)
    assert told[7].remaining_s == pytest.approx(1.0, abs=0.05)


def test_resumed_progress_starts_where_it_was(bench: Bench) -> None:
    bench.drive(fringe_plan(FringesParams(exposures_ms=(2.0,))))
    bench.told.clear()
    bench.drive(fringe_plan(FRINGES))
    told = [live for live in bench.told if live.text.startswith("fringe")]
    assert told[0].text == "fringe at 4 ms, 5 of 8"
    assert told[0].progress == 0.5


def test_progress_of_several_bursts_is_that_of_all(bench: Bench) -> None:
    def plan() -> Plan[None]:
        for number in range(4):
            burst = tuple(Shot(WHITE, 2.0, role=f"{number}/{n}") for n in range(3))
            yield OneOf(burst, number, 4, "look")
        yield (Shot(WHITE, 2.0), Shot(WHITE, 2.0))

    with Shooter(bench.rig, bench.control) as shooter:
        session = bench.session(shooter, bench.control)
        session.clock = lambda: float(len(shots))
        shots: list[str] = []
        session.seen = lambda camera, frame, row: shots.append(camera) if camera == "left" else None
        session.run_plan(plan())
    told = [live for live in bench.told if " of " in live.text]
    assert told[0].text == "look 1 of 4: 0/0 at 2 ms, 1 of 3"
    assert told[11].text == "look 4 of 4: 3/2 at 2 ms, 3 of 3"
    assert [live.progress for live in told] == pytest.approx([*(n / 12 for n in range(12)), 0, 0.5])
    assert told[0].remaining_s is None
    # A burst of its own is told as before.
    assert told[12].text == "uniform at 2 ms, 1 of 2"


# rendering


PATTERNS: list[tuple[Pattern, list[int]]] = [
    (Uniform(gray=7), [7, 7, 7, 7]),
    (StaticPicture(), [0, 0, 0, 0]),
    (Stripe(periods=2), [255, 0, 255, 0]),
    (Gray(bit=0, bits=2, codes=4), [0, 255, 255, 0]),
    (Gray(bit=0, bits=2, codes=4, inverse=True), [255, 0, 0, 255]),
    (Sine(periods=1, shift_rad=-np.pi / 4, low_gray=40, high_gray=220), [220, 130, 40, 130]),
]


@pytest.mark.parametrize(("pattern", "line"), PATTERNS, ids=lambda p: getattr(p, "kind", ""))
def test_every_kind_of_pattern_is_rendered(pattern: Pattern, line: list[int]) -> None:
    picture = render(pattern, width_px=4, height_px=2)
    assert picture.tolist() == [line, line]


def test_a_mask_dims_the_light_not_the_code() -> None:
    mask = np.array([[1.0, 0.25]], np.float32)
    assert render(WHITE, width_px=2, height_px=1, mask=mask).tolist() == [[255, 64]]
    # Light is (code / 255) ** 2: a quarter of the light is half the code.
    assert render(WHITE, width_px=2, height_px=1, mask=mask, gamma=2.0).tolist() == [[255, 128]]


def test_a_mask_of_another_projector_is_refused() -> None:
    with pytest.raises(StageFailedError, match="mask is 2 x 1 px, the projector 4 x 2"):
        render(WHITE, width_px=4, height_px=2, mask=np.ones((1, 2), np.float32))


def test_masks_reach_the_projector(bench: Bench) -> None:
    half = np.ones((8, 32), np.float32)
    half[:, :16] = 0.0
    bench.drive(once(Shot(WHITE, 2.0, mask=InMemory(half))))
    (picture,) = bench.rig.projector.loaded
    assert (picture[:, :16].max(), picture[:, 16:].min()) == (0, 255)
    row = next(iter(bench.journal.rows.values()))
    assert np.array_equal(bench.store.get(row.document["mask"]), half)
