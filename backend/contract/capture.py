"""The import format: a folder with a `capture.json`. Scans made here are exported in the same form.

`x_to = R x_from + t`, OpenCV's conventions, pixel centres at integers. `projector`, `extrinsics`, `K`,
`exposure_ms`, `stage` and `mask` may be absent or null.
"""

from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from backend.domain.patterns import Pattern

Matrix3 = Annotated[tuple[tuple[float, float, float], ...], Field(min_length=3, max_length=3)]
Vector3 = tuple[float, float, float]


class _Part(BaseModel):
    """Numbers are finite; unknown fields are kept out of the way (other people's notes)."""

    model_config = ConfigDict(
        frozen=True, extra="ignore", allow_inf_nan=False, use_attribute_docstrings=True
    )


class CapturedCamera(_Part):
    """One camera of a capture."""

    width_px: int = Field(gt=0, le=20_000)
    height_px: int = Field(gt=0, le=20_000)
    bit_depth: int = Field(8, ge=8, le=16)
    K: Matrix3 | None = None
    distortion: tuple[float, ...] | None = None
    """OpenCV's k1 k2 p1 p2 k3."""
    black_level_gray: float | None = None
    full_well_e: float | None = None
    read_noise_e: float | None = None


class CapturedProjector(_Part):
    """The projector or screen of a capture."""

    width_px: int = Field(gt=0, le=20_000)
    height_px: int = Field(gt=0, le=20_000)
    K: Matrix3 | None = None
    distortion: tuple[float, ...] | None = None
    frame_period_ms: float | None = None
    gamma: float | None = None


class Extrinsics(_Part):
    """Where one device stands to another: x_to = R x_from + t."""

    model_config = ConfigDict(
        frozen=True, extra="ignore", allow_inf_nan=False, populate_by_name=True
    )

    kind: Literal["stereo", "camera-projector"]
    from_: str = Field(alias="from")
    to: str
    R: Matrix3
    t_mm: Vector3


def _no_nones(value: Any) -> Any:
    return value or None


class JournalPlace(_Part):
    """Which shot of which capture a frame is: written by our own exports, so that they can be driven again."""

    take: int = Field(ge=0)
    occurrence: int = Field(ge=0)
    """0 for the first time that the plan asked for this shot, 1 for the second ..."""
    exposure_ms: float = Field(gt=0)
    """As the plan asked for it; the frame's own exposure is what the camera made of it."""
    gain_db: float = 0.0
    mask: str | None = None
    """File (.npy) of the intensity mask, bit by bit."""
    captured: datetime
    metadata: dict[str, float | int | str | bool] = {}
    """What the camera told of the frame."""


class CapturedFrame(_Part):
    """One picture file and what it shows."""

    file: str = Field(min_length=1)
    """Path relative to `capture.json`."""
    camera: str
    exposure_ms: float | None = Field(None, gt=0)
    gain_db: float = 0.0
    pattern: Pattern
    stage: Annotated[str | None, BeforeValidator(_no_nones)] = None
    """Stage whose result the frame belongs to; None: the method's main capture."""
    role: str = ""
    mask: str | None = None
    """File of the intensity mask that the pattern was multiplied with."""
    journal: JournalPlace | None = None


class Capture(_Part):
    """A `capture.json`, whole."""

    format: Literal["unglare-capture"]
    version: Literal[1]
    name: str
    method: str
    cameras: dict[str, CapturedCamera] = Field(min_length=1)
    projector: CapturedProjector | None = None
    extrinsics: tuple[Extrinsics, ...] = ()
    frames: tuple[CapturedFrame, ...] = Field(min_length=1)
    reference: str | None = None
    """Reference camera; None: `left`, else the first one."""

    @model_validator(mode="after")
    def _names_are_known(self) -> "Capture":
        devices = set(self.cameras) | ({"projector"} if self.projector else set())
        for i, frame in enumerate(self.frames):
            if frame.camera not in self.cameras:
                raise ValueError(
                    f"frame {i} ({frame.file}) is of camera {frame.camera!r}; cameras are {sorted(self.cameras)}"
                )
        for link in self.extrinsics:
            if missing := {link.from_, link.to} - devices:
                raise ValueError(
                    f"extrinsics name {sorted(missing)}, which isn't among the devices {sorted(devices)}"
                )
        if self.reference is not None and self.reference not in self.cameras:
            raise ValueError(
                f"reference camera {self.reference!r} isn't among {sorted(self.cameras)}"
            )
        return self

    @property
    def reference_camera(self) -> str:
        """Name of the reference camera."""
        if self.reference is not None:
            return self.reference
        return "left" if "left" in self.cameras else next(iter(self.cameras))
