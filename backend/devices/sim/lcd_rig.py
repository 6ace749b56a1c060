"""The simulated rig for mirrors: one camera that sees a screen in the part, all in physical units."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from threading import Lock

import numpy as np
from jaxtyping import Float32, UInt8, UInt16

from backend.devices.errors import RigConfigError
from backend.devices.opening import open_all
from backend.devices.options import read_options
from backend.devices.protocols import Camera, DeviceInfo
from backend.devices.sim import kernels, lcd_kernels
from backend.devices.sim.camera import Exposure, SimulatedCamera
from backend.devices.sim.chains import (
    CHAINS,
    DISPLAYS,
    FULL_WELL_E,
    READ_NOISE_E,
    TONES,
    Chain,
    Curve,
    measured_curve,
)
from backend.devices.sim.clock import Clock, MachineClock
from backend.devices.sim.lcd_config import SimulatedLcdConfig
from backend.devices.sim.lcd_layout import screen_model
from backend.devices.sim.lcd_light import Panel
from backend.devices.sim.lcd_light import light as light_of
from backend.devices.sim.lcd_world import LcdWorld, lcd_world
from backend.devices.sim.mirrors import check_mirror
from backend.devices.sim.renderer import Light
from backend.devices.sim.rig_info import rig_info
from backend.devices.sim.screen import Lit, SimulatedScreen, share_of_before
from backend.domain.rig import CameraFacts, Pose, ProjectorFacts, RigCalibration, RigFacts
from backend.numerics.mirror_scoring import MirrorTruth
from backend.numerics.scoring import Truth

NAME = "camera"
_DIMMED = 0.7
_TONE_STEPS = 1 << 14


def create_lcd_rig(config: Mapping[str, object]) -> "SimulatedLcdRig":
    """Build the simulated rig for mirrors from options; see `SimulatedLcdConfig` for what there is.

    Raises
    ------
    RigConfigError
        If an option or the scene is unknown or can't be used.
    """
    return SimulatedLcdRig(read_options(SimulatedLcdConfig, "simulated rig", config))


create_lcd_rig.options_model = SimulatedLcdConfig  # type: ignore[attr-defined]  # read by loading.options_schema


class SimulatedLcdRig:
    """A `Rig` that knows the truth. Rays are followed when the rig is opened: seconds, once per process.

    Parameters
    ----------
    config
        Mirror, screen and camera.
    light
        What the mirror shows instead of the rig's own screen, e.g. a real monitor that is watched. The rig then
        keeps the machine's time, `time.monotonic()`.
    """

    def __init__(self, config: SimulatedLcdConfig, light: Light | None = None) -> None:
        check_mirror(config.scene)
        self.config = config
        self.chain = chain_of(config)
        self._clock = Clock(realtime=config.realtime) if light is None else MachineClock()
        self._screen = SimulatedScreen(config, self._clock)
        self._camera = SimulatedCamera(
            NAME,
            config,
            self._clock,
            look=lambda: light or self._screen.shown,
            develop=self._develop,
            trigger_phase=lambda frame_id: 0.0,
        )
        self._panel = Panel(config, self.chain.luminance(np.arange(256)))
        self._tone = self.chain.tone(np.linspace(0.0, 1.0, _TONE_STEPS + 1)).astype(np.float32)
        self._loading = Lock()
        self._world: LcdWorld | None = None
        self._patterned = 0
        self._last: UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"] | None = None

    @property
    def name(self) -> str:
        """Name under which it is opened."""
        return "sim-lcd"

    @property
    def info(self) -> DeviceInfo:
        """Who built the rig: we did."""
        return rig_info(
            f"simulated screen and mirror, {self.config.scene}, chain {self.config.chain}"
        )

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """The one camera."""
        return {NAME: self._camera}

    @property
    def projector(self) -> SimulatedScreen:
        """The screen."""
        return self._screen

    def open(self) -> None:
        """Follow the rays and open the devices."""
        self._load()
        open_all((self._screen, self._camera))

    def close(self) -> None:
        """Close the devices; what the rays met is kept for the next rig like this one."""
        self._camera.close()
        self._screen.close()

    def __enter__(self) -> "SimulatedLcdRig":
        self.open()
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def facts(self) -> RigFacts:
        """Return sizes, ranges and noise. What the screen makes of its codes isn't known."""
        c = self.config
        camera = CameraFacts(
            width_px=c.size[0],
            height_px=c.size[1],
            bit_depth=c.bit_depth,
            exposure_min_ms=c.exposure_min_ms,
            exposure_max_ms=c.exposure_max_ms,
            black_level_gray=0.0,
            full_well_e=FULL_WELL_E,
            read_noise_e=READ_NOISE_E,
            gain_max_db=c.gain_max_db,
        )
        return RigFacts({NAME: camera}, NAME, ProjectorFacts(*c.screen_size))

    def calibration(self) -> RigCalibration | None:
        """Return where camera, screen and mirror are, exactly; None if the configuration says uncalibrated."""
        if not self.config.calibrated:
            return None
        here = self._load().layout
        return RigCalibration(
            cameras={NAME: here.camera},
            camera_from_world={NAME: Pose(np.eye(3), np.zeros(3))},
            reference=NAME,
            screen=screen_model(self.config),
            screen_from_world=here.screen_from_camera,
            mirror_from_world=here.mirror_from_camera if self.config.mirror_pose_known else None,
        )

    def truth(self, reference: str, cameras: Sequence[str] | None = None) -> Truth:
        """Return the true surface behind the camera's pixels, in its frame; for reports only."""
        return self._load().truth()

    def mirror_truth(self, reference: str) -> MirrorTruth:
        """Return true slopes and heights in the mirror's frame; for reports only."""
        return self._load().mirror_truth()

    def _load(self) -> LcdWorld:
        with self._loading:
            if self._world is None:
                self._world = lcd_world(self.config)
            return self._world

    def _develop(self, exposure: Exposure) -> UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"]:
        defect = self._defect(exposure)
        picture = self._picture(
            light_of(self._load().footprints, self._shown(exposure), self.config.lens_blur_px),
            exposure,
            {"dropped": 0.0, "dimmed": _DIMMED}.get(defect, 1.0),
        )
        if defect == "duplicated" and self._last is not None and self._last.dtype == picture.dtype:
            picture = self._last.copy()
        self._last = picture
        return picture

    def _defect(self, exposure: Exposure) -> str:
        """Return what is wrong with this frame; empty: nothing."""
        if self.config.defect_frame is None:
            return ""
        pattern = exposure.shown.during(exposure.start_s, exposure.end_s)[-1][0].pattern
        if pattern.min() == pattern.max():
            return ""
        self._patterned += 1
        return self.config.defect if self._patterned == self.config.defect_frame + 1 else ""

    def _shown(self, exposure: Exposure) -> Float32[np.ndarray, "hs ws"]:
        shown = exposure.shown
        if not isinstance(shown, Lit):
            parts = shown.during(exposure.start_s, exposure.end_s)
            pictures = [np.float32(share) * self._panel.steady(one) for one, share in parts]
            return np.asarray(np.sum(pictures, axis=0), np.float32)
        before = share_of_before(
            shown.since_s,
            1e-3 * self.config.response_ms,
            exposure.start_s,
            1e-6 * exposure.settings.exposure_us,
        )
        return self._panel.picture(shown.pattern, shown.before, before, shown.number)

    def _picture(
        self, luminance: Float32[np.ndarray, "h w"], exposure: Exposure, factor: float
    ) -> UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"]:
        exposed = exposure.settings.exposure_us * 1e-3 / self.config.nominal_exposure_ms
        seeds = np.random.SeedSequence([self.config.seed, 2, exposure.frame_id]).generate_state(2)
        out = np.empty(luminance.shape, np.uint8 if exposure.bits == 8 else np.uint16)
        f32 = np.float32
        with kernels.LOCK:
            lcd_kernels.develop(
                *(luminance, np.uint32(seeds[0]), np.uint32(seeds[1]), kernels.NORMAL),
                self.config.noise,
                f32(FULL_WELL_E * self.chain.exposure * exposed * factor),
                f32(READ_NOISE_E**2),
                f32(10 ** (exposure.settings.gain_db / 20) / FULL_WELL_E),
                *(self._tone * f32(2**exposure.bits - 1), out),
            )
        return out


def chain_of(config: SimulatedLcdConfig) -> Chain:
    """Return the chain of a configuration: the lettered one, with what the options replace.

    Raises
    ------
    RigConfigError
        If a curve isn't known or a display's file can't be read.
    """
    chain = CHAINS[config.chain]
    display, black = chain.display, chain.black
    if config.display in DISPLAYS:
        display = DISPLAYS[config.display]
    elif config.display:
        display, black = _measured(Path(config.display))
    if config.tone and config.tone not in TONES:
        raise RigConfigError(
            f"simulated rig: there is no tone curve {config.tone!r}; choose {', '.join(TONES)}"
        )
    return Chain(
        chain.name,
        display,
        TONES.get(config.tone, chain.tone),
        black if config.black_share is None else config.black_share,
        chain.exposure if config.white_exposure is None else config.white_exposure,
    )


def _measured(file: Path) -> tuple[Curve, float]:
    """Read codes and luminances; return the curve between black and white, and black over white."""
    try:
        codes, luminance = np.loadtxt(file, delimiter=",", unpack=True, ndmin=2)
    except (OSError, ValueError) as error:
        raise RigConfigError(
            f"simulated rig: display {file} can't be read ({error}); choose {', '.join(DISPLAYS)},"
            " or a CSV file with a code (0 to 255) and a luminance per line"
        ) from error
    black, white = luminance[0], luminance[-1]
    if not 0 <= black < white:
        raise RigConfigError(
            f"simulated rig: display {file} has {black:g} at its first and {white:g} at its last code;"
            " sort it by code, black first"
        )
    return measured_curve(codes / 255.0, (luminance - black) / (white - black)), black / white
