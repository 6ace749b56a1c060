"""The rigs of one station: built in, from packages, and the files in its folder."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import yaml
from pydantic import BaseModel, ConfigDict

from backend.devices.calibration_entries import CalibrationEntry
from backend.devices.dlpc350_protocol import SHOW_PERIOD_US, SIZE_PX
from backend.devices.errors import RigConfigError, RigNotFoundError
from backend.devices.loading import available_rigs, open_rig
from backend.devices.options import DisplaySize
from backend.devices.pages import PageDesk
from backend.devices.plain_yaml import read_yaml
from backend.devices.protocols import Rig
from backend.devices.rig_file import RigFile, assemble
from backend.devices.whole_files import write_whole

CALIBRATION_SUFFIX = ".calibration.yaml"
"""Beside a rig's file: where its devices are, if the file doesn't say it itself."""
_NAMED_CALIBRATION = re.compile(r"^calibration:[ \t]*[^\s{#][^\n]*$", re.MULTILINE)
LATENCY_SUFFIX = ".latency.json"
"""Beside a rig's file: what the latency calibration found."""
ASSUMED_REFRESH_HZ = 60.0
"""Of a display that tells no refresh rate."""
_NAME = re.compile(r"[a-z0-9][a-z0-9-]{0,40}")


class DisplayMode(BaseModel):
    """What a measured latency holds for: another monitor or mode has another one."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    size: DisplaySize
    refresh_hz: float | None = ASSUMED_REFRESH_HZ

    @property
    def mode(self) -> tuple[tuple[int, int], float]:
        """What has to be the same."""
        return self.size, self.refresh_hz or ASSUMED_REFRESH_HZ


class KnownLatency(DisplayMode):
    """What is read of the file beside a rig's file."""

    settle_ms: float
    exposure_ms: float | None = None
    screen: str = ""
    """Which screen it was measured on; empty: not known."""


@dataclass(frozen=True)
class KeptRig:
    """A rig file on the shelf."""

    name: str
    path: Path


def _same_mode(known: KnownLatency, said: Mapping[str, object], *, measures_itself: bool) -> bool:
    """Tell whether a projector's entry says the mode that a latency was measured in; a page looks at its rate itself."""
    now = DisplayMode.model_validate(said)
    if measures_itself and said.get("refresh_hz") is None:
        return known.size == now.size
    return known.mode == now.mode


def _rate_of(said: Mapping[str, object], known: KnownLatency) -> float:
    """Return the rate at which a LightCrafter repeats a single pattern, as it was measured where it is the same."""
    period_us = float(str(said.get("show_period_us", SHOW_PERIOD_US)))
    measured_hz = known.refresh_hz or ASSUMED_REFRESH_HZ
    return measured_hz if abs(1e6 / measured_hz - period_us) < 0.5 else 1e6 / period_us


class RigShelf:
    """Rig files in a folder, `NAME.yaml`; read anew each time, so that an edited file counts at once.

    Parameters
    ----------
    folder
        Where they are; made when the first one is added.
    desk
        The application's projector pages.
    """

    def __init__(self, folder: Path, desk: PageDesk) -> None:
        self._folder = folder
        self._desk = desk

    def kept(self) -> tuple[KeptRig, ...]:
        """Return the files, by name; one whose name is no rig's couldn't be opened and is left out."""
        paths = sorted(self._folder.glob("*.yaml"))
        return tuple(KeptRig(path.stem, path) for path in paths if _NAME.fullmatch(path.stem))

    def open(self, name: str, options: Mapping[str, object]) -> Rig:
        """Make a rig: of its file if there is one, else by its name.

        Raises
        ------
        RigNotFoundError, RigConfigError
            If there is no such rig, or its file or an option can't be used.
        """
        path = self._folder / f"{name}.yaml"
        if not (_NAME.fullmatch(name) and path.is_file()):
            known = [*(r.name for r in available_rigs()), *(r.name for r in self.kept())]
            if ":" not in name and name not in known:
                raise RigNotFoundError(
                    f"there is no rig {name!r}; choose {', '.join(known)}, or give package.module:factory"
                )
            return open_rig(name, options)
        if options:
            raise RigConfigError(
                f"rig {name} is described by {path} and takes no options, but got {', '.join(options)}; edit the file"
            )
        return assemble(name, self._with_latency(name, self.read(name)), self._desk)

    def read(self, name: str) -> RigFile:
        """Read a rig's file, and the calibration beside it.

        Raises
        ------
        RigNotFoundError, RigConfigError
            If there is none, or it can't be used.
        """
        file = RigFile.read(self.require(name))
        beside = self.calibration_path(name)
        if file.calibration is not None or not beside.is_file():
            return file
        document = {**file.model_dump(mode="json"), "calibration": read_yaml("calibration", beside)}
        return RigFile.of(document, f"{self._folder / name}.yaml with {beside.name}")

    def calibration_path(self, name: str) -> Path:
        """Return where a rig's calibration is kept if its file doesn't hold it."""
        return self._folder / f"{name}{CALIBRATION_SUFFIX}"

    def keep_calibration(self, name: str, entry: CalibrationEntry, source: str) -> Path:
        """Keep a calibration beside a rig's file, in place of the one before.

        Raises
        ------
        RigNotFoundError
            If there is no rig file of this name.
        RigConfigError
            If the file holds a calibration itself, or the new one is for other cameras.
        """
        path, file = self.require(name), RigFile.read(self.require(name))
        if file.calibration is not None:
            raise RigConfigError(
                f"rig file {path} holds a calibration itself; take that entry out of it first"
            )
        RigFile.of(
            {**file.model_dump(mode="json"), "calibration": entry.model_dump(mode="json")},
            str(path),
        )
        return self._write_calibration(name, entry, source)

    def _write_calibration(self, name: str, entry: CalibrationEntry, source: str) -> Path:
        text = yaml.safe_dump(
            entry.model_dump(mode="json"), sort_keys=False, default_flow_style=None
        )
        head = f"# from {source}; x_device = R x_world + t_mm in mm, as OpenCV has it\n"
        return write_whole(self.calibration_path(name), head + text)

    def _with_latency(self, name: str, file: RigFile) -> RigFile:
        """Let the projector wait as long as was measured, unless its entry says how long or has changed since."""
        try:
            text = self._latency_path(name).read_text("utf-8")
            known = KnownLatency.model_validate_json(text)
            said = dict(file.projector.model_extra or {})
            if file.projector.driver == "dlpc350":
                said = {"size": SIZE_PX, "refresh_hz": _rate_of(said, known), **said}
            same = _same_mode(known, said, measures_itself=file.projector.driver == "page")
        except (OSError, ValueError):
            return file
        if not same or "settle_ms" in said:
            return file
        told: dict[str, object] = {"settle_ms": known.settle_ms}
        if file.projector.driver == "page":
            # The page finds out whether it is on the same screen still.
            told = {"measured": known.model_dump(exclude={"size"})}
        projector = file.projector.model_copy(update=told)
        return file.model_copy(update={"projector": projector})

    def _latency_path(self, name: str) -> Path:
        return self._folder / f"{name}{LATENCY_SUFFIX}"

    @property
    def folder(self) -> Path:
        """Where the files are."""
        return self._folder

    def add(self, source: Path, name: str = "") -> KeptRig:
        """Check a file and copy it onto the shelf, under its own name or another one.

        Raises
        ------
        RigConfigError
            If it can't be used, or the name is taken or isn't one.
        """
        name = name or source.stem
        if not _NAME.fullmatch(name):
            raise RigConfigError(
                f"{name!r} is no name for a rig: use small letters, digits and dashes, e.g. `bench-2`"
            )
        if name in {rig.name for rig in available_rigs()} | {rig.name for rig in self.kept()}:
            raise RigConfigError(
                f"there is a rig {name!r} already; remove it first, or choose another name"
            )
        file = RigFile.read(source)
        assemble(name, file, self._desk)
        text = source.read_text("utf-8-sig")
        if file.calibration is None or isinstance(
            read_yaml("rig file", source)["calibration"], dict
        ):
            return KeptRig(name, write_whole(self._folder / f"{name}.yaml", text))
        # The name of a file counts from where the rig file was: here it would lead nowhere.
        named = _NAMED_CALIBRATION.search(text)
        if named is None:
            raise RigConfigError(
                f"rig file {source} names its calibration in the middle of a line; write `calibration: FILE` on one of its own"
            )
        text = text.replace(named.group(), f"# calibration: see {name}{CALIBRATION_SUFFIX}")
        beside = self._write_calibration(name, file.calibration, str(source))
        try:
            return KeptRig(name, write_whole(self._folder / f"{name}.yaml", text))
        except RigConfigError:
            beside.unlink(missing_ok=True)
            raise

    def remove(self, name: str) -> Path:
        """Take a file off the shelf, and calibration and latency, which needn't hold for the next rig of that name.

        They are renamed, not deleted; the rig's is returned.

        Raises
        ------
        RigNotFoundError
            If there is none of this name.
        """
        path = self.require(name)
        for beside in (self._latency_path(name), self.calibration_path(name)):
            if beside.exists():
                beside.rename(beside.with_name(f"{beside.name}.removed"))
        return path.rename(path.with_suffix(".yaml.removed"))

    def require(self, name: str) -> Path:
        """Return the path of a rig's file.

        Raises
        ------
        RigNotFoundError
            If there is none of this name.
        """
        path = self._folder / f"{name}.yaml"
        if not (_NAME.fullmatch(name) and path.is_file()):
            known = ", ".join(rig.name for rig in self.kept()) or "none"
            raise RigNotFoundError(f"there is no rig file {name!r}; there are: {known}")
        return path
