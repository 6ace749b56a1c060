"""How a field of a result wants to be looked at. The UI has one view per kind and knows no stage.

A hint goes into the annotation: `Annotated[Float[np.ndarray, "gray"], Histogram("Gray levels")]`.
A field may be one per camera: `Annotated[Mapping[str, Float[np.ndarray, "h w"]], Picture("Phase")]`.
Names in a hint (`x`, `fit`, `edits`, `scalars` ...) refer to sibling fields, `edits` to a setting of the stage.
"""

from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass(frozen=True)
class Hint:
    """What all hints have."""

    title: str

    @property
    def kind(self) -> str:
        """Lower-case name of the kind, e.g. `picture`."""
        return type(self).__name__.lower()

    def describe(self) -> dict[str, Any]:
        """Return the hint as a JSON document with its kind."""
        return {"kind": self.kind, **asdict(self)}


@dataclass(frozen=True)
class Value(Hint):
    """One number or text, shown in the stage's list of facts."""

    unit: str = ""
    digits: int = 4
    """Significant digits shown."""


@dataclass(frozen=True)
class Picture(Hint):
    """A map h x w of gray levels or of a quantity; NaN is drawn as missing."""

    unit: str = ""
    colormap: str = "gray"
    """gray, turbo, viridis, twilight (cyclic) or inferno."""
    low: float | None = None
    """Value at the lower end of the colours; None: the 1 % percentile."""
    high: float | None = None
    x: str | None = None
    """Field with the value of each column, where the picture is a function of two settings."""
    y: str | None = None
    """Field with the value of each row."""
    point: str | None = None
    """Field with the (x, y) that was chosen, drawn as a marker."""
    edits: str | None = None
    """Setting that takes a point picked in the picture (with `point`), or a painted picture (without): an
    `ArrayHash` of factors in [0, 1], NaN where nothing was painted."""


@dataclass(frozen=True)
class Frames(Hint):
    """Captured frames: one picture out of a list, chosen by camera, exposure and pattern."""

    x: str | None = None
    """Field with a number per frame of each camera: a pixel that is clicked shows its gray levels over it."""
    slope: str | None = None
    """Field, a map per camera, with the slope of the line fitted to each pixel."""
    offset: str | None = None
    """Field, a map per camera, with the offset of that line."""


@dataclass(frozen=True)
class Mask(Hint):
    """A map of labels or of reason bits, drawn in flat colours with a legend."""

    labels: dict[int, str] = field(default_factory=dict)
    """Text of each label (or of each bit's value, with `bits`); 0 is drawn transparent if absent."""
    bits: bool = False
    names: str | None = None
    """Field with a text per label, the first for label 1, where the texts depend on the result."""
    edits: str | None = None
    """Setting that takes a painted mask: an `ArrayHash` of a whole map, 0 where there is nothing."""


@dataclass(frozen=True)
class Curve(Hint):
    """One or several curves over an axis; the field is (n,) or (curves, n)."""

    x: str | None = None
    """Field with the axis' values; None: 0, 1, 2 ..."""
    x_title: str = ""
    unit: str = ""
    log_y: bool = False
    names: tuple[str, ...] = ()
    """What each of several curves is called in the legend."""


@dataclass(frozen=True)
class Histogram(Hint):
    """Counts per gray level, with fitted curve and zone borders that can be dragged."""

    fit: str | None = None
    """Field with the fitted curve, same length."""
    valleys: str | None = None
    """Field with the borders between zones in [gray]."""
    peaks: str | None = None
    edits: str | None = None
    """Setting that takes the dragged borders."""
    x_title: str = "gray"


@dataclass(frozen=True)
class Table(Hint):
    """A tuple of frozen dataclasses, one per row, or a mapping from name to number."""

    edits: str | None = None
    """Setting that takes an edited column."""


@dataclass(frozen=True)
class Points(Hint):
    """Points n x 3 in [mm], with what they can be coloured by."""

    normals: str | None = None
    colour: str | None = None
    """Field n x 3 uint8."""
    scalars: tuple[str, ...] = ()
    """Fields (n,) to colour by; their titles and units come from their own hints."""


@dataclass(frozen=True)
class Scalar(Hint):
    """A quantity per point (n,), only shown as a colour of the points."""

    unit: str = ""


@dataclass(frozen=True)
class Mesh(Hint):
    """Triangles: field is vertices n x 3 in [mm]."""

    faces: str = "faces"
