"""What all cameras have in common whose library reads their GenICam description."""

from backend.devices.drivers.library_camera import LibraryCamera
from backend.devices.drivers.sfnc import SfncControls, SfncOptions
from backend.devices.drivers.sfnc_features import Features
from backend.devices.protocols import CameraSettings, DeviceInfo, TriggerSource

_FREE_RUN_BUFFERS = 3
"""So few that what waits is soon thrown away."""


class SfncCamera(LibraryCamera):
    """A `LibraryCamera` that is set through its features.

    Parameters
    ----------
    name
        The camera's name in its rig.
    info
        Where it is looked for.
    options
        What the rig file says.
    fewest_buffers
        How many buffers its library needs to go on while frames are fetched.
    """

    def __init__(
        self, name: str, info: DeviceInfo, options: SfncOptions, *, fewest_buffers: int
    ) -> None:
        super().__init__(name, info)
        self._sfnc_options = options
        self._fewest_buffers = fewest_buffers
        self._known_controls: SfncControls | None = None
        self._notes: tuple[str, ...] = ()
        self._remarks: tuple[str, ...] = ()

    @property
    def notes(self) -> tuple[str, ...]:
        """Say what was found set otherwise than a scan needs it, and what its owner should know of."""
        return self._notes

    @property
    def remarks(self) -> tuple[str, ...]:
        """Say what is doubtful: what a viewer left on, and can't be switched off from here."""
        return self._remarks

    @property
    def _controls(self) -> SfncControls:
        assert self._known_controls is not None, "made by _prepare"
        return self._known_controls

    def _prepare(self, features: Features, *, hardware_timestamp: bool) -> None:
        """Overrule what else was set before us; afterwards there are controls."""
        self._known_controls = SfncControls(
            self.name,
            features,
            self._sfnc_options,
            buffered_frames=_FREE_RUN_BUFFERS,
            hardware_timestamp=hardware_timestamp,
        )
        self._known_controls.prepare()
        self._notes = self._known_controls.notes()
        self._remarks = self._known_controls.left_on.remaining

    def _buffers_for(self, n_frames: int | None) -> int:
        """Return how many buffers an acquisition of so many frames is given; None: as many as come."""
        if self._settings.trigger is TriggerSource.FREE_RUN:
            return _FREE_RUN_BUFFERS
        return max(self._fewest_buffers, (n_frames or 0) + 2)

    def _apply(self, wanted: CameraSettings) -> CameraSettings:
        return self._controls.apply(wanted, self._settings)
