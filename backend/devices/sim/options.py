"""What the options of all simulated rigs have in common: the ranges of sizes, depths and exposures."""

from typing import Any

from pydantic import field_validator

from backend.devices.options import DeviceOptions, Size


class RigOptions(DeviceOptions):
    """Options of a simulated rig, checked."""

    @field_validator("size", "projector_size", "screen_size", check_fields=False)
    @classmethod
    def _size_in_range(cls, value: Size) -> Size:
        width, height = value
        if not (64 <= width <= 8192 and 48 <= height <= 8192):
            raise ValueError(f"{width}x{height} is not within 64x48 to 8192x8192")
        return value

    @field_validator("bit_depth", check_fields=False)
    @classmethod
    def _has_pixel_format(cls, value: int) -> int:
        if value not in (8, 12):
            raise ValueError(f"{value} is not one of 8, 12")
        return value

    @field_validator("exposure_max_ms", check_fields=False)
    @classmethod
    def _longer_than_min(cls, value: float, info: Any) -> float:
        shortest = info.data.get("exposure_min_ms", 0.0)
        if value <= shortest:
            raise ValueError(f"{value:g} is not above exposure_min_ms {shortest:g}")
        return value
