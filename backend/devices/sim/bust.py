"""A plaster bust of a bearded man, made of a profile and displacements: the scenes' organic shape."""

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator

from backend.devices.sim.shapes import Mesh, bump, grid

# height, half width, half depth, forward shift of the axis, all in mm
_PROFILE = np.array(
    [
        (0, 43, 33, 0),
        (9, 43, 33, 0),
        (12, 37, 28, 0),
        (20, 36, 27, 0),
        (30, 52, 33, 0),
        (48, 70, 38, 0),
        (62, 73, 38, -1),
        (73, 62, 35, -2),
        (81, 41, 31, -2),
        (89, 31, 29, 0),
        (97, 30, 31, 3),
        (106, 34, 37, 5),
        (120, 37.5, 42, 5),
        (138, 39, 44, 4),
        (155, 38.5, 44, 2),
        (168, 35, 40, 0),
        (180, 26, 30, -2),
        (187, 15, 17, -3),
        (190, 0.05, 0.05, -3),
    ]
)

Map = Float[np.ndarray, "rows columns"]


def bust(*, rows: int = 520, columns: int = 900) -> Mesh:
    """Make the bust: base at y = 0, 190 mm high, facing +z."""
    height = (190.0 * np.sin(np.linspace(np.pi / 2, 0, rows)))[:, None]
    angle = np.linspace(0, 2 * np.pi, columns, endpoint=False)[None, :]
    angle = np.where(angle > np.pi, angle - 2 * np.pi, angle)
    half_width, half_depth, shift = (
        PchipInterpolator(_PROFILE[:, 0], _PROFILE[:, k])(height) for k in (1, 2, 3)
    )
    # A squarer cross-section in the chest than in the head.
    power = np.where(height < 80, 2.6, 2.15)
    radius = (
        np.abs(np.sin(angle) / half_width) ** power + np.abs(np.cos(angle) / half_depth) ** power
    ) ** (-1 / power)
    fade = np.clip((190 - height) / 12, 0, 1)
    radius = radius + fade * _relief(angle, height, radius)
    x, z = radius * np.sin(angle), radius * np.cos(angle) + shift
    return grid(np.stack([x, np.broadcast_to(height, x.shape), z], -1), closed=True)


def _relief(angle: Map, height: Map, radius: Map) -> Map:
    """Return the displacement along the radius in [mm]: face, hair, beard, coat."""
    side = np.abs(angle) * radius
    face = bump(angle, 0.62) * bump(height - 134, 24)
    return (
        _features(side, height)
        + _strands(angle, height) * _hairiness(angle, height) * (1 - 0.5 * face)
        + _coat(angle, height)
    )


def _features(side: Map, height: Map) -> Map:
    nose_top, nose_tip = 147.0, 127.0
    along = np.clip((nose_top - height) / (nose_top - nose_tip), 0, 1.0)
    below = bump(np.minimum(height - nose_tip, 0), 1.8)
    nose = (2.0 + 8.5 * along**1.4) * bump(side, 3.0 + 1.6 * along) * below
    nose = np.where(height > nose_top, 2.0 * bump(side, 4) * bump(height - nose_top, 5), nose)
    eyes = -4.2 * bump(side - 14, 5.5) * bump(height - 141, 4.2)
    lids = 2.4 * bump(side - 14, 4.2) * bump(height - 140.5, 2.2)
    brows = 3.0 * bump(side - 14, 9) * bump(height - 148.5, 2.6)
    cheeks = 2.4 * bump(side - 19, 8) * bump(height - 130, 6)
    lip = 2.2 * bump(side, 8) * bump(height - 113, 2.0)
    mouth = -2.2 * bump(side, 9) * bump(height - 116.4, 1.2)
    moustache = 3.2 * bump(side - 8, 8) * bump(height - 120 + 0.25 * side, 2.8)
    return nose + eyes + lids + brows + cheeks + lip + mouth + moustache


def _hairiness(angle: Map, height: Map) -> Map:
    """Return 1 on hair and beard, 0 on skin and coat."""
    hair = 1 / (1 + np.exp(-(height - 158 + 26 * np.minimum(np.abs(angle), 1.6)) / 3.0))
    hair = hair / (1 + np.exp(-(height - 96) / 4.0))
    beard = bump(angle, 0.75) * bump(height - 99, 11.0)
    return np.clip(hair + 1.1 * beard, 0, 1.4)


def _strands(angle: Map, height: Map) -> Map:
    """Return wavy locks, mean about +2 mm, in [mm]."""
    drift = height / 9.0 + 1.4 * np.sin(height / 11.0 + 2 * np.sin(2 * angle))
    coarse = np.sin(17 * angle + drift) * np.sin(height / 4.2 + 3 * np.sin(5 * angle))
    fine = np.sin(41 * angle + 1.7 * drift + np.sin(height / 3.0))
    return 2.4 + 1.2 * coarse + 0.45 * fine


def _coat(angle: Map, height: Map) -> Map:
    """Return lapels and folds of the coat, in [mm]."""
    below = 1 / (1 + np.exp((height - 76) / 2.0)) / (1 + np.exp(-(height - 27) / 2.0))
    opening = 0.012 * (height - 28)
    lapel = 2.2 / (1 + np.exp(-(np.abs(angle) - opening) / 0.03))
    folds = 0.7 * np.sin(7 * np.abs(angle) + height / 9.0)
    shirt = -1.2 * bump(angle, 0.04) * (height > 28)
    return below * (lapel + folds + shirt)
