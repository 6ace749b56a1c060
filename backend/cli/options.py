"""Options that several commands share, and what they mean."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from backend.domain.errors import InvalidSettingError

if TYPE_CHECKING:
    from backend.contract.requests import GivenSource
    from backend.services.array_uploads import UploadKind
    from backend.services.services import Services

Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="STAGE.FIELD=VALUE",
        help="Set one field of a stage's settings, e.g. exposures.budget=fast; JSON or text, "
        "or for a mask the name of a picture or .npy file. Repeatable.",
    ),
]
Given = Annotated[
    list[str] | None,
    typer.Option(
        "--given",
        metavar="TYPE=SCAN|FOLDER|NUMBER",
        help="Take a result from another scan, an exported folder or a calibration by its number, instead of the "
        "rig's newest; TYPE=none takes none. Repeatable.",
    ),
]
RigName = Annotated[
    str,
    typer.Option(
        "--rig", help="simulated, the name of an installed rig, or package.module:factory."
    ),
]
RigOptions = Annotated[
    list[str] | None,
    typer.Option(
        "--rig-option",
        metavar="KEY=VALUE",
        help="One option of the rig, e.g. bit_depth=12; JSON or text. Repeatable.",
    ),
]
Scene = Annotated[
    str | None,
    typer.Option(
        help="Scene of a simulated rig: high-contrast, metal, workpieces, plane, sphere, step, "
        "sprayed:NAME, mesh:FILE; mirror-flat, -parabola, -freeform, -dent, mirror:FILE.  "
        "[default: high-contrast]",
        show_default=False,
    ),
]
ScanRig = Annotated[
    str | None,
    typer.Option(
        "--rig",
        help="simulated, sim-lcd, the name of an installed rig, or package.module:factory.  "
        "[default: the simulated rig that has the scene, or that the method is made for]",
        show_default=False,
    ),
]
Chain = Annotated[
    str | None,
    typer.Option(
        metavar="LETTER",
        help="Response of the simulated screen and camera, A (linear) to G.  [default: D]",
        show_default=False,
    ),
]
Size = Annotated[
    str | None,
    typer.Option(
        metavar="WIDTHxHEIGHT",
        help="Size of the simulated cameras.  [default: 1280x960]",
        show_default=False,
    ),
]
ProjectorSize = Annotated[
    str | None,
    typer.Option(
        metavar="WIDTHxHEIGHT",
        help="Size of the simulated projector.  [default: 1280x800]",
        show_default=False,
    ),
]
Seed = Annotated[
    int | None, typer.Option(help="Seed of the simulated noise.  [default: 0]", show_default=False)
]
DataFolder = Annotated[
    Path | None,
    typer.Option(
        "--data",
        help="Folder of database and artifacts.  [default: UNGLARE_DATA_FOLDER or ~/.local/share/unglare]",
        show_default=False,
    ),
]
AsJson = Annotated[
    bool, typer.Option("--json", help="Print one JSON object last, and nothing else.")
]
Quiet = Annotated[bool, typer.Option("--quiet", help="Show no progress.")]


_ID_LENGTH = 16
"""Ids of scans are so long; calibrations have short numbers."""


def parse_value(text: str) -> Any:
    """Read a value as JSON, as a list of JSON values, or else as text.

    Examples
    --------
    >>> parse_value("3"), parse_value("null"), parse_value("fast")
    (3, None, 'fast')
    >>> parse_value("16.7, 100"), parse_value("50,")
    ([16.7, 100], [50])
    """
    for attempt in (text, f"[{text.removesuffix(',')}]" if "," in text else text):
        try:
            return json.loads(attempt, parse_constant=_refuse_constant)
        except ValueError:
            continue
    return text


def _refuse_constant(name: str) -> Any:
    raise ValueError(name)  # NaN and Infinity are no JSON


def parse_settings(texts: Iterable[str] | None) -> dict[str, dict[str, Any]]:
    """Read `STAGE.FIELD=VALUE`, the last one of a field counts.

    Raises
    ------
    InvalidSettingError
        Naming the text that isn't of that form.

    Examples
    --------
    >>> parse_settings(["zones.gap_gray=9", "exposures.exposures_ms=10,20"])
    {'zones': {'gap_gray': 9}, 'exposures': {'exposures_ms': [10, 20]}}
    """
    settings: dict[str, dict[str, Any]] = {}
    for text in texts or ():
        path, equals, value = text.partition("=")
        stage, dot, field = path.strip().partition(".")
        if not (equals and dot and stage and field):
            raise InvalidSettingError(
                f"--set {text} can't be read: write STAGE.FIELD=VALUE, e.g. exposures.budget=fast "
                "(unglare methods shows stages and fields)."
            )
        settings.setdefault(stage, {})[field] = parse_value(value.strip())
    return settings


def parse_given(texts: Iterable[str] | None) -> "dict[str, GivenSource | None]":
    """Read `TYPE=SCAN|FOLDER|NUMBER|none`, the last one of a type counts.

    Raises
    ------
    InvalidSettingError
        Naming the text that isn't of that form.

    Examples
    --------
    >>> parse_given(["Ramp=3", "TableHomography=none"])
    {'Ramp': GivenSource(calibration=3, scan=None, folder=None), 'TableHomography': None}
    """
    given: dict[str, GivenSource | None] = {}
    for text in texts or ():
        kind, equals, value = (part.strip() for part in text.partition("="))
        if not (equals and kind and value):
            raise InvalidSettingError(
                f"--given {text} can't be read: write TYPE=SCAN, TYPE=FOLDER, TYPE=NUMBER or TYPE=none, "
                "e.g. Ramp=3 (unglare calibrations list shows numbers)."
            )
        given[kind] = None if value == "none" else _source(value)
    return given


def _source(value: str) -> "GivenSource":
    from backend.contract.requests import GivenSource

    if value.isdecimal() and len(value) < _ID_LENGTH:
        return GivenSource(calibration=int(value))
    folder = Path(value).expanduser()
    if folder.exists() or len(folder.parts) > 1:
        return GivenSource(folder=str(folder.absolute()))
    return GivenSource(scan=value)


def parse_rig_options(
    texts: Iterable[str] | None,
    *,
    scene: str | None = None,
    size: str | None = None,
    projector_size: str | None = None,
    seed: int | None = None,
    chain: str | None = None,
) -> dict[str, Any]:
    """Read `KEY=VALUE` and put the options of the simulated rig with them, as far as they are given.

    Raises
    ------
    InvalidSettingError
        Naming the text that isn't of that form.
    """
    named = {
        "scene": scene,
        "size": size,
        "projector_size": projector_size,
        "seed": seed,
        "chain": chain,
    }
    options = {name: value for name, value in named.items() if value is not None}
    for text in texts or ():
        key, equals, value = text.partition("=")
        if not (equals and key.strip()):
            raise InvalidSettingError(
                f"--rig-option {text} can't be read: write KEY=VALUE, e.g. bit_depth=12."
            )
        options[key.strip()] = parse_value(value.strip())
    return options


def with_uploads(
    services: "Services", method_name: str, settings: dict[str, dict[str, Any]]
) -> dict[str, dict[str, Any]]:
    """Put files that settings name instead of arrays into the store, e.g. `refine_1.paint=mask.png`.

    Raises
    ------
    InvalidSettingError
        If such a file isn't there or can't be read; the sentence names setting and file.
    """
    kinds = _array_settings(services, method_name)
    return {
        stage: {
            field: _uploaded(services, f"{stage}.{field}", value, kinds[stage, field])
            if (stage, field) in kinds
            else value
            for field, value in values.items()
        }
        for stage, values in settings.items()
    }


def _array_settings(services: "Services", method_name: str) -> "dict[tuple[str, str], UploadKind]":
    """Return the settings that name arrays; one that can be painted in a picture takes a mask."""
    from backend.domain.arrays import ARRAY_FORMAT
    from backend.services.array_uploads import UploadKind

    method = next((m for m in services.methods().methods if m.name == method_name), None)
    kinds = {}
    for stage in method.stages if method else ():
        painted = {shown.hint.get("edits") for shown in stage.shown}
        for field, described in stage.settings.get("properties", {}).items():
            ways = (described, *described.get("anyOf", ()))
            if any(way.get("format") == ARRAY_FORMAT for way in ways):
                is_mask = field in painted
                kinds[stage.name, field] = UploadKind.MASK if is_mask else UploadKind.ARRAY
    return kinds


def _uploaded(services: "Services", path: str, value: Any, kind: "UploadKind") -> Any:
    from backend.services.array_uploads import looks_like_hash

    if not isinstance(value, str) or looks_like_hash(value):
        return value
    try:
        data = Path(value).expanduser().read_bytes()
    except OSError as error:
        raise InvalidSettingError(
            f"--set {path}={value}: the file can't be read ({error.strerror}); name a .npy file or a gray picture."
        ) from None
    return services.upload_array(data, kind).hash
