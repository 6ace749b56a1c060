"""A set of patterns in a folder: pictures for projectors that play from memory, and what each of them is.

`patterns.json` lists the pictures in their order. A set may also be packed into 24-bit images, as the memory of a
DLPC350 holds them: three patterns of 8 bit or 24 of 1 bit each.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import UInt8
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from backend.devices.errors import RigConfigError

INDEX_FILE = "patterns.json"
FORMAT = "unglare patterns 1"

_CHANNELS = (1, 0, 2)
"""A 24-bit image's patterns lie in its green, red and blue bits, in this order; here the place in RGB."""
_BITS = 8


class _Entry(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


class SetPattern(_Entry):
    """One picture of a set."""

    number: int = Field(ge=0)
    file: str
    what: str
    """In words."""
    stages: tuple[str, ...] = ()
    """Stages that show it."""
    pattern: dict[str, Any] | None = None
    """As data; None: it belongs to no scan, e.g. a test pattern."""
    hash: str
    """See `pattern_hash`."""
    image: int | None = Field(None, ge=0)
    """Which of the packed images holds it; None: the set isn't packed."""
    position: int | None = Field(None, ge=0)
    """Its place in that image: 0 is the first 1 or 8 bits."""


class PatternSet(_Entry):
    """What is in a folder."""

    format: Literal["unglare patterns 1"] = "unglare patterns 1"
    method: str = ""
    width_px: int = Field(gt=0)
    height_px: int = Field(gt=0)
    gamma: float = Field(1.0, gt=0)
    """Of the projector that the pictures were rendered for."""
    bit_depth: Literal[1, 8] = 8
    """Bits per pattern of the packed images."""
    patterns: tuple[SetPattern, ...]
    images: tuple[str, ...] = ()
    """Files of the packed images, in the order of the projector's memory."""
    left_out: tuple[str, ...] = ()
    """What a scan shows besides and no file can hold, and why; one sentence each."""
    files: tuple[str, ...] = ()
    """Everything that was written beside the list."""

    @classmethod
    def read(cls, folder: Path) -> "PatternSet":
        """Read a folder's list.

        Raises
        ------
        RigConfigError
            If there is none, or it isn't one.
        """
        path = folder / INDEX_FILE
        try:
            return cls.model_validate_json(path.read_bytes())
        except OSError as error:
            raise RigConfigError(
                f"pattern set {path} can't be read ({error.strerror}); name the folder of an exported set"
                " (unglare patterns export)"
            ) from error
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            place = ".".join(map(str, first["loc"])) or "the whole file"
            raise RigConfigError(
                f"pattern set {path} can't be used ({place}: {first['msg']}); export it anew"
            ) from None

    def image_pictures(self, folder: Path) -> tuple[UInt8[np.ndarray, "h w 3"], ...]:
        """Read the packed images, as RGB.

        Raises
        ------
        RigConfigError
            If one is missing or has another size.
        """
        return tuple(self._image(folder / name) for name in self.images)

    def _image(self, path: Path) -> UInt8[np.ndarray, "h w 3"]:
        picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if picture is None or picture.shape[:2] != (self.height_px, self.width_px):
            raise RigConfigError(
                f"image {path} of a pattern set can't be read as {self.width_px}x{self.height_px} px; export the set anew"
            )
        return np.ascontiguousarray(picture[:, :, ::-1], dtype=np.uint8)


@dataclass(frozen=True)
class NewPattern:
    """A picture that is to be written."""

    picture: UInt8[np.ndarray, "h w"]
    what: str
    pattern: dict[str, Any] | None = None
    stages: tuple[str, ...] = ()


def write_set(
    folder: Path,
    patterns: Sequence[NewPattern],
    *,
    method: str = "",
    gamma: float = 1.0,
    pack: bool = False,
    left_out: Sequence[str] = (),
) -> PatternSet:
    """Write pictures as PNG, numbered in their order, and the list of them; packed, also the images for a DLPC350.

    The images are BMP files: the program that builds the projector's flash wants those.

    Raises
    ------
    OSError
        If the folder can't be written.
    """
    pictures = [pattern.picture for pattern in patterns]
    depth = bit_depth_for(pictures)
    each = 24 // depth
    digits = max(3, len(str(len(patterns) - 1)))
    entries = tuple(
        SetPattern(
            number=number,
            file=f"pattern_{number:0{digits}d}.png",
            what=new.what,
            stages=new.stages,
            pattern=new.pattern,
            hash=pattern_hash(new.picture),
            image=number // each if pack else None,
            position=number % each if pack else None,
        )
        for number, new in enumerate(patterns)
    )
    groups = [pictures[i : i + each] for i in range(0, len(pictures), each)] if pack else []
    height_px, width_px = pictures[0].shape
    images = tuple(f"flash_{number:02d}.bmp" for number in range(len(groups)))
    written = PatternSet(
        method=method,
        width_px=width_px,
        height_px=height_px,
        gamma=gamma,
        bit_depth=depth,
        patterns=entries,
        images=images,
        left_out=tuple(left_out),
        files=(*(entry.file for entry in entries), *images),
    )
    folder.mkdir(parents=True, exist_ok=True)
    for entry, picture in zip(entries, pictures, strict=True):
        write_picture(folder / entry.file, picture)
    for name, group in zip(written.images, groups, strict=True):
        write_picture(folder / name, packed(group, depth)[:, :, ::-1])
    (folder / INDEX_FILE).write_text(written.model_dump_json(indent=2) + "\n", "utf-8")
    return written


def write_picture(
    path: Path, picture: UInt8[np.ndarray, "h w"] | UInt8[np.ndarray, "h w 3"]
) -> None:
    """Write a gray picture, or a coloured one as BGR, in the format that the file's name says.

    Raises
    ------
    OSError
        If it can't be written.
    """
    _, data = cv2.imencode(path.suffix, np.ascontiguousarray(picture))
    path.write_bytes(data.tobytes())


def pattern_hash(picture: UInt8[np.ndarray, "h w"]) -> str:
    """Identify a picture by its size and pixels (sha256, hexadecimal)."""
    height_px, width_px = picture.shape
    digest = hashlib.sha256(f"{width_px}x{height_px}".encode())
    digest.update(picture.tobytes())
    return digest.hexdigest()


def bit_depth_for(pictures: Sequence[UInt8[np.ndarray, "_ _"]]) -> Literal[1, 8]:
    """Return 1 if all pictures are black and white, else 8.

    One depth for all: white of 1 bit isn't exactly as bright as white of 8 bit.
    """
    return 1 if all(np.isin(picture, (0, 255)).all() for picture in pictures) else 8


def packed(
    pictures: Sequence[UInt8[np.ndarray, "h w"]], bit_depth: Literal[1, 8]
) -> UInt8[np.ndarray, "h w 3"]:
    """Pack up to three pictures of 8 bit, or 24 of 1 bit, into one RGB image; what is left over stays black."""
    image = np.zeros((*pictures[0].shape, 3), np.uint8)
    for position, picture in enumerate(pictures):
        channel, bit = _place(position, bit_depth)
        image[:, :, channel] |= picture if bit is None else (picture >> 7) << bit
    return image


def unpacked(
    image: UInt8[np.ndarray, "h w 3"], position: int, bit_depth: int
) -> UInt8[np.ndarray, "h w"]:
    """Take one picture of 1 or 8 bit out of an RGB image again."""
    channel, bit = _place(position, bit_depth)
    plane = image[:, :, channel]
    if bit is None:
        return np.ascontiguousarray(plane)
    return np.where(plane >> bit & 1, 255, 0).astype(np.uint8)


def _place(position: int, bit_depth: int) -> tuple[int, int | None]:
    if bit_depth == _BITS:
        return _CHANNELS[position], None
    return _CHANNELS[position // _BITS], position % _BITS
