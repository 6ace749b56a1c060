"""Rig files: which cameras and which projector make up a rig, in YAML.

::

    cameras:
      left:  {driver: aravis, address: 192.168.10.2, sensor: {full_well_e: 10500, read_noise_e: 6.5}}
      right: {driver: aravis, address: 192.168.10.3, sensor: {full_well_e: 10500, read_noise_e: 6.5}}
    projector: {driver: page, size: 1280x800}
    snap_exposures: true

The first camera is the reference unless `reference: right` says otherwise. `trigger_line: Line1` says which line of a camera the projector's trigger output
drives; `limits: {longest_exposure_ms: 500, largest_gain_db: 12}` what a camera shall not be used beyond. What a driver
needs besides (`address` above) is its own matter: `unglare drivers NAME`. `calibration` is an entry
(`backend/devices/calibration_entries.py`) or the name of a file that holds one.
"""

import re
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any, get_args

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    TypeAdapter,
    ValidationError,
    field_validator,
    model_validator,
)

from backend.devices.assembled import AssembledRig, CameraLimits, SensorFacts
from backend.devices.calibration_entries import CalibrationEntry
from backend.devices.driver_loading import make_camera, make_projector
from backend.devices.errors import RigConfigError
from backend.devices.options import DisplaySize, meant, shortened, telling
from backend.devices.pages import PageDesk
from backend.devices.plain_yaml import read_yaml
from backend.devices.protocols import Projector, SequenceProjector, TriggerSource

_LINES = [s.value for s in TriggerSource if s.value.startswith("Line")]
_IDENTITIES = ("address", "serial", "source", "device")
"""Options that drivers tell devices apart by."""
_DISPLAY: TypeAdapter[tuple[int, int]] = TypeAdapter(DisplaySize)
_CAMERA_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,40}")


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class SensorEntry(_Part):
    """A camera's data sheet."""

    bit_depth: int | None = Field(None, ge=8, le=16)
    black_level_gray: float = Field(0.0, ge=0)
    full_well_e: float = Field(10_000.0, gt=0)
    read_noise_e: float = Field(10.0, ge=0)


class LimitsEntry(_Part):
    """What a camera shall not be used beyond, though it could."""

    longest_exposure_ms: float | None = Field(None, gt=0)
    largest_gain_db: float | None = Field(None, ge=0)


class CameraEntry(BaseModel):
    """One camera; keys that aren't named here go to its driver."""

    model_config = ConfigDict(frozen=True, extra="allow", allow_inf_nan=False)

    driver: str
    sensor: SensorEntry = SensorEntry()
    trigger_line: TriggerSource | None = None
    """The line that the projector's trigger output drives; None: not wired."""
    limits: LimitsEntry = LimitsEntry()

    def same_device(self, other: "CameraEntry") -> str:
        """Return the option by which another entry means the same device; empty: it means another one."""
        mine, its = self.model_extra or {}, other.model_extra or {}
        same = [k for k in _IDENTITIES if mine.get(k) is not None and mine.get(k) == its.get(k)]
        return f"{same[0]} {mine[same[0]]}" if same and self.driver == other.driver else ""

    @field_validator("trigger_line")
    @classmethod
    def _is_a_line(cls, value: TriggerSource | None) -> TriggerSource | None:
        if value in (TriggerSource.SOFTWARE, TriggerSource.FREE_RUN):
            raise ValueError(f"{value} is no line: give one of {', '.join(_LINES)}")
        return value


class ProjectorEntry(BaseModel):
    """The projector; keys that aren't named here go to its driver."""

    model_config = ConfigDict(frozen=True, extra="allow", allow_inf_nan=False)

    driver: str
    gamma: float = Field(1.0, gt=0.2, lt=5)


class RigFile(_Part):
    """A rig as its owner describes it."""

    title: str = ""
    cameras: dict[str, CameraEntry] = Field(min_length=1)
    reference: str | None = None
    """The camera whose pixels are measured; None: the first."""
    projector: ProjectorEntry
    snap_exposures: bool = True
    """Exposures are whole frame periods of the projector, so that its modulation averages out."""
    calibration: CalibrationEntry | None = None

    @classmethod
    def read(cls, path: Path) -> "RigFile":
        """Read and check a file.

        Raises
        ------
        RigConfigError
            If it can't be read, isn't YAML, or an entry is unknown, missing or can't be used.
        """
        document = read_yaml("rig file", path)
        if isinstance(document, dict) and isinstance(document.get("calibration"), str):
            document["calibration"] = read_yaml(
                f"rig file {path}: calibration", path.parent / document["calibration"]
            )
        return cls.of(document, str(path))

    @classmethod
    def of(cls, document: object, name: str) -> "RigFile":
        """Check a document; `name` is what sentences call it."""
        try:
            return cls.model_validate(document)
        except ValidationError as error:
            first = telling(error.errors(include_url=False))
            raise RigConfigError(f"rig file {name}: {_problem(cls, first)}") from None

    @property
    def page(self) -> str | None:
        """Name of the projector page that shows its patterns; None where no page does."""
        options = self.projector.model_extra or {}
        return str(options.get("page", "projector")) if self.projector.driver == "page" else None

    @property
    def display_px(self) -> tuple[int, int] | None:
        """Width and height of the projector, if its entry says it in the usual way."""
        try:
            return _DISPLAY.validate_python((self.projector.model_extra or {}).get("size"))
        except ValidationError:
            return None

    @field_validator("cameras")
    @classmethod
    def _named_for_files(cls, value: dict[str, CameraEntry]) -> dict[str, CameraEntry]:
        for name in value:
            if not _CAMERA_NAME.fullmatch(name) or name == "projector":
                raise ValueError(
                    f"{name!r} is no name for a camera: use letters, digits, dashes and underscores, and not `projector`"
                )
        return value

    @model_validator(mode="after")
    def _refers_to_its_cameras(self) -> "RigFile":
        if self.reference is not None and self.reference not in self.cameras:
            raise ValueError(
                f"reference {self.reference!r} is none of its cameras: choose {', '.join(self.cameras)}"
            )
        for one, other in combinations(self.cameras, 2):
            same = self.cameras[one].same_device(self.cameras[other])
            if same:
                raise ValueError(
                    f"{one} and {other} are the same device ({same}): give each its own"
                )
        return self

    @property
    def reference_camera(self) -> str:
        """Name of the reference camera."""
        return self.reference or next(iter(self.cameras))

    @model_validator(mode="after")
    def _no_strangers(self) -> "RigFile":
        if self.calibration is not None and set(self.calibration.cameras) != set(self.cameras):
            calibrated, there = sorted(self.calibration.cameras), sorted(self.cameras)
            raise ValueError(f"its calibration is for cameras {calibrated}, the rig has {there}")
        return self


def assemble(name: str, file: RigFile, desk: PageDesk) -> AssembledRig:
    """Make a rig of its file; nothing is opened yet.

    Raises
    ------
    RigConfigError
        If a driver is unknown, isn't installed or refuses its options.
    """
    cameras = {
        camera: make_camera(camera, entry.driver, _options(entry))
        for camera, entry in file.cameras.items()
    }
    projector = make_projector(
        "projector", file.projector.driver, _options(file.projector), desk.for_rig(name)
    )
    _refuse_useless_wires(file, projector)
    first, known = file.reference_camera, file.calibration
    return AssembledRig(
        name,
        {first: cameras[first], **cameras},
        projector,
        sensors={
            camera: SensorFacts(**entry.sensor.model_dump())
            for camera, entry in file.cameras.items()
        },
        gamma=file.projector.gamma,
        calibration=known.calibration(first) if known else None,
        calibrated_px=known.sizes_px if known else None,
        trigger_lines={c: e.trigger_line for c, e in file.cameras.items() if e.trigger_line},
        limits={c: CameraLimits(**e.limits.model_dump()) for c, e in file.cameras.items()},
        snap_exposures=file.snap_exposures,
    )


def _options(entry: CameraEntry | ProjectorEntry) -> Mapping[str, Any]:
    return dict(entry.model_extra or {})


def _refuse_useless_wires(file: RigFile, projector: Projector) -> None:
    """Refuse trigger lines where nothing drives them: the rig would be slower than its owner thinks."""
    wired = [name for name, entry in file.cameras.items() if entry.trigger_line]
    if wired and not isinstance(projector, SequenceProjector):
        raise RigConfigError(
            f"{wired[0]}: trigger_line {file.cameras[wired[0]].trigger_line} has no use, projector driver"
            f" {file.projector.driver} has no trigger output; leave it out"
        )


def _problem(model: type[BaseModel], found: Any) -> str:
    """Say what is wrong with an entry, and which there are where it is unknown."""
    *above, last = found["loc"] or ("",)
    place = shortened(".".join(map(str, found["loc"]))) or "the whole file"
    if found["type"] == "missing":
        return f"{place} is missing; add it"
    if found["type"] == "extra_forbidden":
        known = list(_model_at(model, above).model_fields)
        within = f" in {'.'.join(map(str, above))}" if above else ""
        unknown = shortened(repr(str(last)))
        return f"there is no entry {unknown}{within}; the entries are {', '.join(known)}{meant(str(last), known)}"
    problem = str(found["msg"]).removeprefix("Value error, ")
    problem = problem[0].lower() + problem[1:]
    if isinstance(found["input"], str | int | float | bool):
        return f"{place} can't be {shortened(repr(found['input']))}: {problem}; mend it"
    of_all = not found["loc"] and found["type"] == "value_error"  # it names the place itself
    return f"{problem}; mend it" if of_all else f"{place}: {problem}; mend it"


def _model_at(model: type[BaseModel], path: Sequence[Any]) -> type[BaseModel]:
    """Return the model of an entry, by the names that lead to it."""
    for step in path:
        field = model.model_fields.get(str(step))
        if field is not None:
            kinds = (field.annotation, *get_args(field.annotation))
            kinds = (*kinds, *(inner for kind in kinds for inner in get_args(kind)))
            model = next(
                (k for k in kinds if isinstance(k, type) and issubclass(k, BaseModel)), model
            )
    return model
