"""What a client may ask for."""

from typing import Any

from pydantic import Field, model_validator

from backend.contract.base import Message
from backend.domain.states import Verdict


class GivenSource(Message):
    """Where a result comes from that is handed to a scan: exactly one of these."""

    calibration: int | None = None
    """Number of a calibration."""
    scan: str | None = None
    """A scan whose present result is taken."""
    folder: str | None = None
    """An export in a folder of the server."""

    @model_validator(mode="after")
    def _one(self) -> "GivenSource":
        if sum(x is not None for x in (self.calibration, self.scan, self.folder)) != 1:
            raise ValueError("name exactly one of calibration, scan and folder")
        return self


class CreateScan(Message):
    """A new scan."""

    method: str
    rig: str = "simulated"
    rig_options: dict[str, Any] = {}
    """What the rig's factory takes, e.g. `{"scene": "high-contrast", "size": "1280x960"}`."""
    name: str = Field("", max_length=200)
    note: str = Field("", max_length=5000)
    preset: str | None = None
    settings: dict[str, dict[str, Any]] = {}
    """Recipe: `{stage: {field: value}}`, on top of defaults and preset."""
    given: dict[str, GivenSource | None] = {}
    """Results to hand over, `{type: source}`, instead of the rig's calibrations; None: not even those."""


class EditSettings(Message):
    """Change settings of one stage. A field set to its default value counts as reset."""

    changes: dict[str, Any]
    """`{field: value}`; None means automatic where the setting allows it."""
    reset: tuple[str, ...] = ()
    """Fields that go back to recipe, preset or default."""
    reason: str = Field("", max_length=1000)
    revision: int
    """The revision that the client looked at. An edit of the same field since then is answered with 409."""


class RedoStage(Message):
    """Take the pictures of a capturing stage again (take + 1); `all` for every capturing stage: the part moved."""

    all: bool = False
    reason: str = Field("", max_length=1000)
    revision: int


class UndoEdit(Message):
    """Take back the last edit that isn't taken back yet."""

    revision: int


class StartRun(Message):
    """Run what isn't current."""

    until: str | None = None
    """Last stage to run; None: to the end."""
    unattended: bool = False
    """Pass review gates on ok and on warning, stop on failure."""


class Decide(Message):
    """Accept or reject the result of a stage run."""

    verdict: Verdict
    reason: str = Field("", max_length=1000)
    proceed: bool = True
    """After accepting, run the next stages."""


class ImportCapture(Message):
    """Import a captured folder that the server can read."""

    path: str
    """Path of `capture.json`."""
    name: str = Field("", max_length=200)


class ExportScan(Message):
    """Write a scan's results into a folder of the server."""

    folder: str
    frames: bool = False
    """Also write the captured frames in the import format."""
