"""The simulated rig: two cameras (or one) and a projector before a scene, all in physical units."""

from collections.abc import Mapping, Sequence
from functools import partial
from threading import Lock

import numpy as np
from jaxtyping import UInt8, UInt16

from backend.devices.opening import open_all
from backend.devices.options import read_options
from backend.devices.protocols import Camera, DeviceInfo
from backend.devices.sim.camera import Exposure, SimulatedCamera
from backend.devices.sim.clock import Clock, MachineClock
from backend.devices.sim.config import SimulatedRigConfig
from backend.devices.sim.layout import layout, relative
from backend.devices.sim.optics import veil
from backend.devices.sim.projector import SimulatedProjector
from backend.devices.sim.renderer import Beam, Light, LightPaths, light_paths
from backend.devices.sim.rig_info import rig_info
from backend.devices.sim.scenes import check_name
from backend.devices.sim.sensor import Sensor
from backend.devices.sim.world import World, world
from backend.domain.rig import (
    CameraFacts,
    Pose,
    ProjectorFacts,
    RigCalibration,
    RigFacts,
)
from backend.numerics.scoring import Truth


def create_rig(config: Mapping[str, object]) -> "SimulatedRig":
    """Build a simulated rig from options; see `SimulatedRigConfig` for what there is.

    Raises
    ------
    RigConfigError
        If an option or the scene is unknown or can't be used.
    """
    return SimulatedRig(read_options(SimulatedRigConfig, "simulated rig", config))


create_rig.options_model = SimulatedRigConfig  # type: ignore[attr-defined]  # read by loading.options_schema


class SimulatedRig:
    """A `Rig` that knows the truth. The scene is cast when the rig is opened: seconds, once per process.

    Parameters
    ----------
    config
        What stands before it, and how it is built.
    light
        What lights the scene instead of the rig's own projector, e.g. a real monitor that is watched. The rig
        then keeps the machine's time, `time.monotonic()`.
    """

    def __init__(self, config: SimulatedRigConfig, light: Light | None = None) -> None:
        check_name(config.scene)
        self.config = config
        self._layout = layout(config)
        self._clock = Clock(realtime=config.realtime) if light is None else MachineClock()
        self._projector = SimulatedProjector(config, self._clock)
        self._cameras = {
            name: SimulatedCamera(
                name,
                config,
                self._clock,
                look=lambda: light or self._projector.shown,
                develop=partial(self._develop, name),
                trigger_phase=partial(self._phase, index),
            )
            for index, name in enumerate(self._layout.cameras)
        }
        self._projector.trigger_lines = [camera.line_edge for camera in self._cameras.values()]
        self._sensors = {
            name: _sensor(config, index) for index, name in enumerate(self._layout.cameras)
        }
        self._loading = Lock()
        self._world: World | None = None
        self._beam: Beam | None = None
        self._paths: dict[str, LightPaths] = {}

    @property
    def name(self) -> str:
        """Name under which it is opened."""
        return "simulated"

    @property
    def info(self) -> DeviceInfo:
        """Who built the rig: we did."""
        return rig_info(f"simulated rig, scene {self.config.scene}")

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """Left and right, or left only; left is the reference."""
        return self._cameras

    @property
    def projector(self) -> SimulatedProjector:
        """The projector."""
        return self._projector

    def open(self) -> None:
        """Cast the scene and open the devices."""
        self._load()
        open_all((self._projector, *self._cameras.values()))

    def close(self) -> None:
        """Close the devices; the cast scene is kept for the next rig like this one."""
        for device in (*self._cameras.values(), self._projector):
            device.close()

    def __enter__(self) -> "SimulatedRig":
        self.open()
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def facts(self) -> RigFacts:
        """Return sizes, ranges and noise."""
        c = self.config
        width, height = c.size
        camera = CameraFacts(
            width_px=width,
            height_px=height,
            bit_depth=c.bit_depth,
            exposure_min_ms=c.exposure_min_ms,
            exposure_max_ms=c.exposure_max_ms,
            black_level_gray=c.black_level_gray * 2.0 ** (c.bit_depth - 8),
            full_well_e=c.full_well_e,
            read_noise_e=c.read_noise_e,
            gain_max_db=c.gain_max_db,
        )
        projector = ProjectorFacts(*c.projector_size, c.frame_period_ms, c.gamma)
        return RigFacts(dict.fromkeys(self._cameras, camera), "left", projector)

    def calibration(self) -> RigCalibration | None:
        """Return where the devices are, exactly; None if the configuration says uncalibrated."""
        if not self.config.calibrated:
            return None
        views, reference = self._layout.cameras, self._layout.cameras["left"].device_from_rig
        here = Pose(np.eye(3), np.zeros(3))
        poses = {n: relative(view.device_from_rig, reference) for n, view in views.items()}
        return RigCalibration(
            cameras={name: view.model for name, view in views.items()},
            camera_from_world=poses | {"left": here},
            reference="left",
            projector=self._layout.projector.model,
            projector_from_world=relative(self._layout.projector.device_from_rig, reference),
        )

    def truth(self, reference: str, cameras: Sequence[str] | None = None) -> Truth:
        """Return the true surface behind the pixels of a camera; for reports only."""
        return self._load().truth(reference, tuple(cameras or self._cameras))

    def _load(self) -> World:
        with self._loading:  # both cameras expose at once, each in its own thread
            if self._world is None:
                loaded = world(self.config)
                self._paths, softest = light_paths(loaded.transports, self.config)
                self._beam = Beam(self.config, softest)
                self._world = loaded
            return self._world

    def _develop(
        self, camera: str, exposure: Exposure
    ) -> UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"]:
        self._load()
        assert self._beam is not None
        exposure_ms = exposure.settings.exposure_us * 1e-3
        shown = exposure.shown.during(exposure.start_s, exposure.end_s)
        pictures = self._beam.pictures(shown, exposure_ms, exposure.phase)
        rate = self._paths[camera].light(
            pictures,
            white_e_per_ms=self.config.white_e_per_ms,
            ambient_e_per_ms=self.config.ambient_e_per_ms,
            lens_blur_px=self.config.lens_blur_px,
        )
        return self._sensors[camera].picture(
            rate,
            veil(rate) if self.config.glare_share else rate,
            exposure_ms=exposure_ms,
            gain_db=exposure.settings.gain_db,
            bits=exposure.bits,
            frame_key=exposure.frame_id,
        )

    def _phase(self, camera: int, frame_id: int) -> float:
        """Return where in its frame period the projector is at a software trigger: anywhere."""
        state = np.random.SeedSequence([self.config.seed, 1, camera, frame_id]).generate_state(1)
        return float(state[0]) / 2.0**32


def _sensor(config: SimulatedRigConfig, index: int) -> Sensor:
    seed = np.random.SeedSequence([config.seed, 0, index]).generate_state(1)
    return Sensor(
        full_well_e=config.full_well_e,
        read_noise_e=config.read_noise_e,
        black_level_gray8=config.black_level_gray,
        dark_current_e_per_ms=config.dark_current_e_per_ms,
        blooming_share=config.blooming_share,
        glare_share=config.glare_share,
        hot_pixel_share=config.hot_pixel_share,
        seed=int(seed[0]),
    )
