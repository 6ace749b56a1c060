"""Bursts by the projector's own clock: which shots make a sequence, and what is refused of what comes."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import pytest

from backend.devices.errors import DeviceTimeout, IncompleteFrame
from backend.devices.protocols import CameraSettings, Frame, ProjectorCapabilities, TriggerSource
from backend.devices.sim import create_rig
from backend.domain.errors import RigFailedError
from backend.domain.patterns import WHITE, Pattern, Sine, Uniform
from backend.domain.shots import Exposed, Plan, Shot
from backend.jobs.capture import CaptureSession
from backend.jobs.control import JobControl
from backend.jobs.sequence_shooting import SequenceShooter, shooter_of
from backend.jobs.shooting import Shooter, Take
from backend.storage.artifacts import LocalArtifactStore
from tests.scans.test_capture import MemoryJournal

SMALL = {"scene": "plane", "size": "160x120", "projector_size": "320x200"}
LINES = dict.fromkeys(("left", "right"), TriggerSource.LINE1)


class WiredRig:
    """A simulated rig whose projector's trigger output is wired; its sequences are written down."""

    def __init__(
        self,
        lines: dict[str, TriggerSource] | None = None,
        *,
        most: int = 512,
        certain: bool = True,
        spoil: Callable[[int, list[Frame]], list[Frame]] = lambda run, frames: frames,
    ) -> None:
        self._rig = create_rig(SMALL)
        self.trigger_lines = LINES if lines is None else lines
        self.name = "wired"
        self.info, self.facts = self._rig.info, self._rig.facts
        self.projector = _Recorder(self._rig.projector, most, certain)
        self.cameras = {
            name: _Spoiling(camera, spoil if name == "right" else None)
            for name, camera in self._rig.cameras.items()
        }

    def __getattr__(self, name: str) -> Any:
        return getattr(self._rig, name)

    def __enter__(self) -> "WiredRig":
        self._rig.open()
        return self

    def __exit__(self, *exc: object) -> None:
        self._rig.close()


class _Around:
    """Does what another device does, but for what it overrides."""

    def __init__(self, inner: Any) -> None:
        self.inner = inner

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)


class _Recorder(_Around):
    def __init__(self, inner: Any, most: int, certain: bool) -> None:
        super().__init__(inner)
        self.runs: list[tuple[int, float, float]] = []
        self.shows = 0
        self._most, self._certain = most, certain

    @property
    def capabilities(self) -> ProjectorCapabilities:
        can: ProjectorCapabilities = self.inner.capabilities
        return replace(can, max_sequence=self._most, certain=self._certain)

    def arm_sequence(self, indices: Sequence[int], exposure_us: float, period_us: float) -> None:
        self.runs.append((len(indices), exposure_us, period_us))
        self.inner.arm_sequence(indices, exposure_us, period_us)

    def start_sequence(self) -> None:
        self.inner.start_sequence()

    def stop_sequence(self) -> None:
        self.inner.stop_sequence()

    def show(self, index: int, timeout_s: float = 2.0) -> Any:
        self.shows += 1
        return self.inner.show(index, timeout_s)


class _Spoiling(_Around):
    """Delivers what `spoil` makes of each sequence's frames."""

    def __init__(self, inner: Any, spoil: Callable[[int, list[Frame]], list[Frame]] | None) -> None:
        super().__init__(inner)
        self._spoil = spoil
        self._run = 0
        self._waiting: list[Frame] | None = None
        self._armed = 0
        self.armed: list[int | None] = []
        self.triggers: list[TriggerSource] = []

    def configure(self, settings: CameraSettings) -> CameraSettings:
        self.triggers.append(settings.trigger)
        taken: CameraSettings = self.inner.configure(settings)
        return taken

    def arm(self, n_frames: int | None = None) -> None:
        self.armed.append(n_frames)
        self._waiting, self._armed = None, n_frames or 0
        self.inner.arm(n_frames)

    def get_frame(self, timeout_s: float = 2.0) -> Frame:
        if self._spoil is None or not self._armed:
            frame: Frame = self.inner.get_frame(timeout_s)
            return frame
        if self._waiting is None:
            self._run += 1
            frames = [self.inner.get_frame(timeout_s) for _ in range(self._armed)]
            self._waiting = self._spoil(self._run, frames)
        if not self._waiting:
            raise DeviceTimeout(self.inner.name, "no frame came within 5 s")
        return self._waiting.pop(0)


def fringes(count: int = 4, exposure_ms: float = 10.0, **more: Any) -> tuple[Shot, ...]:
    patterns: list[Pattern] = [
        Sine(periods=8.0, shift_rad=6.283185307179586 * k / count) for k in range(count)
    ]
    return tuple(Shot(p, exposure_ms, role="fringe", **more) for p in patterns)


def once(*shots: Shot) -> Plan[tuple[Exposed, ...]]:
    exposed = yield shots
    return exposed


def captured(
    rig: WiredRig, store: LocalArtifactStore, *shots: Shot
) -> tuple[tuple[Exposed, ...], MemoryJournal]:
    journal = MemoryJournal()
    with shooter_of(rig, JobControl()) as shooter:
        session = CaptureSession(
            scan="s", stage="stage", take=1, facts=rig.facts(), journal=journal, store=store,
            shooter=shooter,
        )  # fmt: skip
        exposed = session.run_plan(once(*shots))
        session.finish()
    return exposed, journal


def test_equal_exposures_make_one_sequence(store: LocalArtifactStore) -> None:
    with WiredRig() as rig:
        exposed, journal = captured(
            rig, store, *fringes(4, 10.0), *fringes(4, 20.0), Shot(WHITE, 20.0)
        )
        assert [run[:2] for run in rig.projector.runs] == [(4, 10_000.0), (5, 20_000.0)]
        assert rig.projector.shows == 0
        assert rig.cameras["left"].armed == [4, 5], "buffers for all"
        assert set(rig.cameras["right"].triggers) == {TriggerSource.LINE1}
        readout_us = 1e6 * rig.cameras["left"].capabilities.min_frame_period_s
        assert all(period > exposure + readout_us for _, exposure, period in rig.projector.runs)
    assert len(journal) == 18
    with create_rig(SMALL) as plain, Shooter(plain, JobControl()) as shooter:
        shown = [s.pattern for s in fringes(4)]
        assert [e["left"].pattern for e in exposed[:4]] == shown
        del shooter
    means = [float(e["left"].gray.mean()) for e in exposed]
    assert means[8] > 1.5 * means[4] > 2.0 * means[0]


def test_long_bursts_are_split(store: LocalArtifactStore) -> None:
    with WiredRig(most=3) as rig:
        captured(rig, store, *fringes(8))
        assert [run[0] for run in rig.projector.runs] == [3, 3, 2]


def test_cameras_that_arent_wired_are_triggered_by_software(store: LocalArtifactStore) -> None:
    with WiredRig({"left": TriggerSource.LINE1}) as rig:
        captured(rig, store, *fringes(4, cameras=("left",)), *fringes(4, 20.0))
        assert [run[0] for run in rig.projector.runs] == [4]
        assert rig.projector.shows == 4
        assert rig.cameras["left"].triggers == [TriggerSource.LINE1, TriggerSource.SOFTWARE]


def test_a_rig_without_wires_shows_pattern_after_pattern() -> None:
    with WiredRig({}) as rig:
        assert type(shooter_of(rig, JobControl())) is Shooter
    with WiredRig() as rig:
        assert isinstance(shooter_of(rig, JobControl()), SequenceShooter)


def _without(n: int) -> Callable[[int, list[Frame]], list[Frame]]:
    """Miss an edge: the frames behind it are those of the next patterns."""
    return lambda run, frames: [f for k, f in enumerate(frames) if k != n] if run == 1 else frames


def _late(n: int) -> Callable[[int, list[Frame]], list[Frame]]:
    def spoil(run: int, frames: list[Frame]) -> list[Frame]:
        late = replace(frames[n], timestamp_s=(frames[n].timestamp_s or 0.0) + 0.009)
        return [*frames[:n], late, *frames[n + 1 :]] if run == 1 else frames

    return spoil


@pytest.mark.parametrize(
    "spoil", [_without(2), _without(0), _late(2)], ids=["missed", "first missed", "late"]
)
def test_a_gap_is_taken_again(
    spoil: Callable[[int, list[Frame]], list[Frame]], store: LocalArtifactStore
) -> None:
    with WiredRig(spoil=spoil) as rig:
        _, journal = captured(rig, store, *fringes(6))
        assert [run[0] for run in rig.projector.runs] == [6, 6]
        assert len(journal) == 12


def test_a_gap_that_stays_ends_in_one_sentence_that_names_the_frame(
    store: LocalArtifactStore,
) -> None:
    def spoil(run: int, frames: list[Frame]) -> list[Frame]:
        return [frames[0], *(replace(f, frame_id=f.frame_id + 1) for f in frames[1:])]

    with WiredRig(spoil=spoil) as rig:
        with pytest.raises(
            RigFailedError, match=r"right: frame 2 of 6 of the sequence has number"
        ) as caught:
            captured(rig, store, *fringes(6))
        assert len(rig.projector.runs) == 3
        assert "0 captured frames are kept" in caught.value.sentence


def test_sequences_are_verified_where_light_isnt_certain(store: LocalArtifactStore) -> None:
    """White and black, marker and step sets, and at the end white again; black, too, where white is saturated."""
    with WiredRig(certain=False) as rig:
        _, journal = captured(rig, store, *fringes(4), *fringes(4, 20.0))
        assert len(journal) == 16
        assert sum(run[0] for run in rig.projector.runs) == 8 + 2 + 1 + 2
        assert rig.projector.shows == 0


def test_a_line_that_a_camera_hasnt_got_is_named(store: LocalArtifactStore) -> None:
    with WiredRig({"left": TriggerSource.LINE1, "right": TriggerSource.LINE4}) as rig:
        with pytest.raises(
            RigFailedError, match="right: the rig file says that it is wired to Line4"
        ):
            captured(rig, store, *fringes(2))


def test_chunks_of_a_wired_rig() -> None:
    with WiredRig(most=4) as rig:
        shooter = shooter_of(rig, JobControl())
        both, left = ("left", "right"), ("left",)
        takes = [Take(n, 10.0, 0.0, both) for n in range(6)] + [
            Take(0, 10.0, 6.0, both),
            Take(0, 10.0, 6.0, left),
        ]
        assert [len(chunk) for chunk in shooter.chunks(takes)] == [4, 2, 1, 1]


def test_only_cameras_that_arent_wired_have_a_grid_of_exposures() -> None:
    with WiredRig({"left": TriggerSource.LINE1}) as rig:
        shooter = shooter_of(rig, JobControl())
        assert shooter.off_grid(("left",), 10.0) == ""
        assert "10 ms is no multiple" in shooter.off_grid(("left", "right"), 10.0)


def test_uniform_fields_come_in_their_order(store: LocalArtifactStore) -> None:
    with WiredRig() as rig:
        exposed, _ = captured(
            rig, store, *(Shot(Uniform(gray=g), 10.0) for g in (0, 60, 120, 180, 240))
        )
    means = [float(e["right"].gray.mean()) for e in exposed]
    assert means == sorted(means)
    assert means[-1] > means[0] + 20


def test_frames_out_of_order_are_refused() -> None:
    """Numbers of software-triggered frames: twice the same is no new frame."""
    from backend.jobs.frame_order import FrameOrder

    with create_rig(SMALL) as rig:
        camera = rig.cameras["left"]
        camera.arm()
        camera.trigger()
        frame = camera.get_frame()
    order = FrameOrder()
    order.check("left", frame)
    with pytest.raises(IncompleteFrame, match="came again"):
        order.check("left", frame)
    with pytest.raises(IncompleteFrame, match="missing"):
        order.check("left", replace(frame, frame_id=frame.frame_id + 5))
    order.check("left", replace(frame, frame_id=frame.frame_id + 9), gaps=True)
    order.forget("left")
    order.check("left", frame)
