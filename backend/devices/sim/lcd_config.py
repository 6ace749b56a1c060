"""Every setting of the simulated rig for mirrors: a camera, a screen, and what it is seen in."""

from typing import Literal

from pydantic import AliasChoices, ConfigDict, Field, field_validator

from backend.devices.options import Size
from backend.devices.sim.chains import CHAINS
from backend.devices.sim.options import RigOptions

Defect = Literal["dropped", "duplicated", "dimmed"]


class SimulatedLcdConfig(RigOptions):
    """A mirror, the screen that the camera sees in it, and what goes wrong with them."""

    model_config = ConfigDict(
        title="Simulated screen and mirror",
        json_schema_extra={"methods": ["fringe-reflection"]},
    )

    scene: str = Field(
        "mirror-parabola",
        examples=[
            "mirror-flat",
            "mirror-parabola",
            "mirror-dent",
            "mirror-dent-flat",
            "mirror-freeform",
        ],
        json_schema_extra={"pattern": "^mirror[-:]"},
    )
    """Name of a mirror, or `mirror:FILE`: heights in [mm] as .npy or .csv, rows from the top, edge to edge."""
    chain: str = Field("D", examples=[*CHAINS])
    """Letter of the response from control value to gray level; A is linear."""
    size: Size = (1280, 960)
    """Width and height of the camera in [px]; `1280x960` is understood too."""
    screen_size: Size = Field(
        (1920, 1080), validation_alias=AliasChoices("screen_size", "projector_size")
    )
    """Width and height of the screen in [px]; the rig's projector."""
    bit_depth: int = 8
    """Bits per pixel that the camera starts with, 8 or 12."""
    seed: int = Field(0, ge=0, lt=2**32)
    """Of the noise: the same seed, settings and order of shots give the same frames."""
    noise: bool = True
    """False: neither shot nor read noise; gray levels are still whole numbers."""
    realtime: bool = False
    """Take as long as the real rig would; False: deliver frames as fast as they are computed."""
    calibrated: bool = True
    """Whether the rig hands its calibration over."""
    mirror_pose_known: bool = True
    """Whether that calibration says where the mirror is."""

    # the mirror
    focal_x_mm: float = 1200.0
    """Of the parabola along its x; positive: concave."""
    focal_y_mm: float = 1200.0
    outline: Literal["circle", "rectangle"] = "circle"
    """A mirror from a file is a rectangle whatever this says."""
    mirror_width_mm: float = Field(150.0, gt=1, le=5000)
    """Width, or diameter."""
    mirror_height_mm: float = Field(120.0, gt=1, le=5000)
    """Height of a rectangle."""
    dent_depth_um: float | None = Field(None, ge=-1000, le=1000)
    """Of a round dent, positive: into the mirror; None: 5 where the scene is a dent, else none."""
    dent_diameter_mm: float = Field(20.0, gt=0)
    dent_at_mm: tuple[float, float] = (20.0, 10.0)
    """Middle of the dent, to the right and up from the mirror's middle."""

    # where things are
    camera_distance_mm: float = Field(700.0, ge=100, le=100_000)
    """From the camera to the mirror's middle."""
    screen_distance_mm: float = Field(500.0, ge=100, le=100_000)
    """From the mirror's middle to the screen's."""
    angle_deg: float = Field(15.0, ge=0, lt=60)
    """Camera below and screen above the mirror's normal by this angle."""
    aim_mm: tuple[float, float] = (0.0, 0.0)
    """Where the camera looks, to the right and up from the mirror's middle."""
    screen_tilt_deg: tuple[float, float] = (0.0, 0.0)
    """The screen turned about its x and y axes, from facing the mirror's middle."""
    screen_offset_mm: tuple[float, float] = (0.0, 0.0)
    """The screen moved along its x and y axes."""
    screen_bow_mm: float = Field(0.0, ge=-100, le=100)
    """How far a bent screen's left and right edges stand before its middle; 0: flat."""
    pixel_pitch_mm: float = Field(0.2767, gt=0)
    """Of the screen's pixels."""
    camera_focal_per_width: float = Field(2.9, gt=0.3)
    camera_distortion: tuple[float, float, float, float, float] = (-0.06, 0.04, 3e-4, -2e-4, 0.0)
    """OpenCV's k1 k2 p1 p2 k3."""

    # light
    display: str = Field("", examples=["linear", "gamma", "lcd", "measured"])
    """The screen's luminance over its code instead of the chain's: a name, or a CSV file of codes and luminances."""
    tone: str = Field("", examples=["linear", "inverse", "film"])
    """The camera's tone curve instead of the chain's."""
    black_share: float | None = Field(None, ge=0, lt=0.9)
    """Luminance of code 0 over that of white; None: the chain's."""
    white_exposure: float | None = Field(None, gt=0, le=20)
    """Charge of white over full scale at the nominal exposure; None: the chain's."""
    nominal_exposure_ms: float = Field(1000 / 30, gt=0)
    """At which white reaches the chain's exposure; at others it is proportional."""
    viewing_loss: float = Field(0.0, ge=0, le=10)
    """The panel is dimmer obliquely: cos(angle) to this power."""
    surround_share: float = Field(0.004, ge=0, le=1)
    """Luminance of everything but the screen, over white: around the mirror, and in it beside the screen."""
    screen_blur_mm: float = Field(0.35, ge=0, le=50)
    """Standard deviation of a point's image on the screen: the camera focuses on the mirror."""
    lens_blur_px: float = Field(0.3, ge=0, le=5)
    """Standard deviation of the camera lens's point image, in camera [px]."""

    # time
    refresh_period_ms: float = Field(1000 / 60, gt=0, le=1000)
    """A pattern appears at the next refresh."""
    response_ms: float = Field(5.0, ge=0, le=1000)
    """Time constant with which the panel's luminance follows."""
    settle_ms: float | None = Field(None, ge=0, le=10_000)
    """How long the screen waits before it says that a pattern is lit; None: as long as the panel needs."""

    # sensor
    exposure_min_ms: float = Field(1.0, gt=0)
    exposure_max_ms: float = Field(2000.0, gt=0)
    gain_max_db: float = Field(12.0, ge=0)

    # what goes wrong
    defect_frame: int | None = Field(None, ge=0)
    """The frame with the defect, counted from 0 over the frames of patterns that aren't uniform."""
    defect: Defect = "dropped"
    """dropped: black; duplicated: the picture of the frame before; dimmed: 0.7 of the light."""
    fault_device: str = "camera"
    """The faults below befall this camera."""
    fail_after_frames: int | None = Field(None, ge=0)
    """The camera is disconnected after so many frames."""
    fail_for_good: bool = False
    """The disconnected camera can't be reconnected."""
    drop_every: int | None = Field(None, ge=2)
    """Every so many frames arrive incomplete."""
    hang_at_frame: int | None = Field(None, ge=0)
    """The frame, counted from 0, that is never delivered."""
    projector_fail_after_shows: int | None = Field(None, ge=0)
    """The screen is disconnected after so many patterns."""

    @field_validator("chain")
    @classmethod
    def _known_chain(cls, value: str) -> str:
        if value.upper() not in CHAINS:
            raise ValueError(f"{value} is not one of {', '.join(CHAINS)}")
        return value.upper()

    @field_validator("focal_x_mm", "focal_y_mm")
    @classmethod
    def _has_curvature(cls, value: float) -> float:
        if abs(value) < 100:
            raise ValueError(f"{value:g} is nearer to 0 than 100 mm")
        return value

    @field_validator("fault_device")
    @classmethod
    def _is_the_camera(cls, value: str) -> str:
        if value != "camera":
            raise ValueError(f"{value} is not camera, the only one")
        return value

    @property
    def screen_size_mm(self) -> tuple[float, float]:
        """Width and height of the screen's picture in [mm]."""
        width, height = self.screen_size
        return width * self.pixel_pitch_mm, height * self.pixel_pitch_mm
