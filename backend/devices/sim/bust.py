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

Map = Float[np.ndarray, "_rows _columns"]


def bust(*, rows: int = 400, columns: int = 640) -> Mesh:
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
    relief: Map = (
        _features(side, height)
        + _strands(angle, height) * _hairiness(angle, height) * (1 - 0.5 * face)
        + _coat(angle, height)
    )
    return relief


def _features(side: Map, height: Map) -> Map:
    bridge, tip = 146.0, 127.0
    along = np.clip((bridge - height) / (bridge - tip), 0, 1.0)
    below = bump(np.minimum(height - tip, 0), 1.8)
    above = bump(np.maximum(height - bridge, 0), 4.0)
    nose = (2.5 + 8.0 * along**1.4) * bump(side, 3.2 + 1.6 * along) * below * above
    wings = 2.6 * bump(side - 5.2, 2.2) * bump(height - 127.5, 2.4)
    sockets = -4.6 * bump(side - 14.5, 6.0) * bump(height - 141, 4.8)
    balls = 3.4 * bump(side - 14.5, 4.4) * bump(height - 140, 2.8)
    lids = -1.1 * bump(side - 14.5, 5.0) * bump(height - 143.4, 0.8)
    brows = 3.4 * bump(side - 14, 8.5) * bump(height - 149.5 + 0.012 * (side - 12) ** 2, 2.4)
    cheeks = 2.4 * bump(side - 19, 7) * bump(height - 131, 6)
    lip = 2.4 * bump(side, 7.5) * bump(height - 113, 1.9)
    mouth = -2.2 * bump(side, 9) * bump(height - 116.2, 1.1)
    moustache = 3.4 * bump(side - 8, 7.5) * bump(height - 120 + 0.28 * side, 2.6)
    relief: Map = nose + wings + sockets + balls + lids + brows + cheeks + lip + mouth + moustache
    return relief


def _hairiness(angle: Map, height: Map) -> Map:
    """Return 1 on hair and beard, 0 on skin and coat."""
    hair = 1 / (1 + np.exp(-(height - 158 + 26 * np.minimum(np.abs(angle), 1.6)) / 3.0))
    hair = hair / (1 + np.exp(-(height - 96) / 4.0))
    beard = bump(angle, 0.75) * bump(height - 99, 11.0)
    share: Map = np.clip(hair + 1.1 * beard, 0, 1.4)
    return share


def _strands(angle: Map, height: Map) -> Map:
    """Return wavy locks, mean about +2 mm, in [mm]."""
    drift = height / 9.0 + 1.4 * np.sin(height / 11.0 + 2 * np.sin(2 * angle))
    coarse = np.sin(17 * angle + drift) * np.sin(height / 5.5 + 3 * np.sin(5 * angle))
    fine = np.sin(41 * angle + 1.7 * drift + np.sin(height / 3.0))
    locks: Map = 2.4 + 1.2 * coarse + 0.45 * fine
    return locks


def _coat(angle: Map, height: Map) -> Map:
    """Return lapels and folds of the coat, in [mm]."""
    below = 1 / (1 + np.exp((height - 76) / 2.0)) / (1 + np.exp(-(height - 27) / 2.0))
    opening = 0.012 * (height - 28)
    lapel = 2.2 / (1 + np.exp(-(np.abs(angle) - opening) / 0.03))
    folds = 0.7 * np.sin(7 * np.abs(angle) + height / 9.0)
    shirt = -1.2 * bump(angle, 0.04) * (height > 28)
    relief: Map = below * (lapel + folds + shirt)
    return relief
