"""Every setting of the simulated rig, in physical units."""

from pydantic import ConfigDict, Field, field_validator

from backend.devices.options import Size
from backend.devices.sim.options import RigOptions


class SimulatedRigConfig(RigOptions):
    """What stands before the simulated rig, how the rig is built, and what goes wrong with it."""

    model_config = ConfigDict(json_schema_extra={"not_for_methods": ["fringe-reflection"]})

    scene: str = Field(
        "high-contrast",
        examples=[
            "high-contrast",
            "metal",
            "workpieces",
            "sprayed:workpieces",
            "plane",
            "sphere",
            "step",
        ],
    )
    """Name of a scene, `sprayed:NAME` for the same geometry in matte white, or `mesh:FILE[?TABLE]`."""
    cameras: int = Field(2, ge=1, le=2)
    """2: left and right; 1: the left one only, with the projector."""
    size: Size = (1280, 960)
    """Width and height of each camera in [px]; `1280x960` is understood too."""
    projector_size: Size = (1280, 800)
    bit_depth: int = 8
    """Bits per pixel that the cameras start with, 8 or 12."""
    seed: int = Field(0, ge=0, lt=2**32)
    """Of the noise: the same seed, settings and order of shots give the same frames."""
    realtime: bool = False
    """Take as long as the real rig would; False: deliver frames as fast as they are computed."""
    calibrated: bool = True
    """Whether the rig hands its calibration over."""
    samples: int = 1
    """Rays per camera pixel, 1, 4 or 16: more smooth the edges and cost as much more."""

    # where things are
    baseline_mm: float = Field(180.0, gt=0)
    """Distance between the cameras; with one camera its distance from where the other would be."""
    distance_mm: float = Field(700.0, ge=300, le=3000)
    """From the middle between the cameras to the scene's centre, on which all devices converge."""
    projector_above_mm: float = 40.0
    camera_focal_per_width: float = Field(1.9, gt=0.3)
    projector_focal_per_width: float = Field(1.75, gt=0.3)
    camera_distortion: tuple[float, float, float, float, float] = (-0.06, 0.04, 3e-4, -2e-4, 0.0)
    """OpenCV's k1 k2 p1 p2 k3, the same for both cameras."""
    projector_distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    # light
    white_e_per_ms: float = Field(300.0, gt=0)
    """Electrons per ms of a pixel that sees a perfect white diffuser facing the white field at 700 mm."""
    ambient_e_per_ms: float = Field(0.6, ge=0)
    """The same from the room's light."""
    gamma: float = Field(1.0, gt=0.2, lt=5)
    """Projected light is (code / 255) ** gamma."""
    contrast_ratio: float = Field(2000.0, gt=1)
    """White field over black field of the projector."""
    frame_period_ms: float | None = Field(1000 / 120, gt=0)
    """Over which the projector modulates each gray level (bit planes); None: steady light."""
    projector_blur_px: float = Field(0.7, ge=0, le=5)
    """Standard deviation of the projector's point image in focus, in projector [px]."""
    projector_aperture_mm: float = Field(4.0, ge=0)
    """Lens opening: how fast the blur grows away from `distance_mm`; 0: everything in focus."""
    lens_blur_px: float = Field(0.4, ge=0, le=3)
    """Standard deviation of the camera lens's point image, in camera [px]."""
    glare_share: float = Field(0.004, ge=0, lt=0.5)
    """Share of the light that the camera lens scatters all over the picture."""

    # sensor
    full_well_e: float = Field(15300.0, gt=100)
    """Electrons at full scale at 0 dB: 60 per gray level at 8 bit."""
    read_noise_e: float = Field(12.0, ge=0)
    black_level_gray: float = Field(4.0, ge=0, lt=100)
    """What a dark pixel reads, in gray levels of 8 bit."""
    dark_current_e_per_ms: float = Field(0.002, ge=0)
    blooming_share: float = Field(0.002, ge=0, le=1)
    """Share of the charge beyond the pixel's capacity that spills into its column."""
    hot_pixel_share: float = Field(0.0, ge=0, lt=0.01)
    """Share of pixels that always read full scale."""
    exposure_min_ms: float = Field(1.0, gt=0)
    exposure_max_ms: float = Field(2000.0, gt=0)
    gain_max_db: float = Field(24.0, ge=0)

    # what goes wrong
    fault_device: str = "left"
    """Name of the camera that the faults below befall."""
    fail_after_frames: int | None = Field(None, ge=0)
    """That camera is disconnected after so many frames."""
    fail_for_good: bool = False
    """The disconnected camera can't be reconnected."""
    drop_every: int | None = Field(None, ge=2)
    """Every so many frames of that camera arrive incomplete."""
    hang_at_frame: int | None = Field(None, ge=0)
    """The frame of that camera, counted from 0, that is never delivered."""
    projector_fail_after_shows: int | None = Field(None, ge=0)
    """The projector is disconnected after so many patterns."""

    @field_validator("samples")
    @classmethod
    def _square_of_two(cls, value: int) -> int:
        if value not in (1, 4, 16):
            raise ValueError(f"{value} is not one of 1, 4, 16")
        return value

    @field_validator("fault_device")
    @classmethod
    def _is_a_camera(cls, value: str) -> str:
        if value not in ("left", "right"):
            raise ValueError(f"{value} is not left or right")
        return value
