"""From places on the screen to the slopes of the mirror, and how they differ from its design."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from backend.domain.arrays import ArrayHash, LoadArray
from backend.domain.checks import Check, at_least
from backend.domain.errors import (
    InvalidCalibrationError,
    InvalidSettingError,
    StageFailedError,
    sentence_of,
)
from backend.domain.hints import Picture, Value
from backend.domain.params import Params, setting
from backend.domain.rig import Pose, RigCalibration
from backend.domain.shots import Progress
from backend.domain.stage import stage
from backend.domain.states import Level, Review
from backend.numerics.camera_model import Pinhole, RigidTransform, rays
from backend.numerics.deflectometry import (
    Alignment,
    MirrorSlopes,
    Surface,
    View,
    follow_deviation,
    paraboloid,
    plane,
    solve_slopes,
)
from backend.numerics.errors import NumericsError, ScreenError
from backend.numerics.height_grid import HeightGrid
from backend.numerics.mirror_pose import circle_outline, pose_from_markers, pose_from_outline
from backend.numerics.screen_phase import check_periods
from backend.numerics.screen_surface import ScreenSurface, screen_surface
from backend.numerics.slope_integration import integrate_slopes
from backend.numerics.surface_maps import curvature
from backend.stages.rig_geometry import from_reference, require_camera
from backend.stages.screen_phase import ScreenPhase

PoseFrom = Literal["given", "outline", "markers"]
Design = Literal["fit", "plane", "parabola", "map"]
Marker = Annotated[
    tuple[float, float, float, float, float], "column and row in px; x, y, z on the mirror in mm"
]
Corner = Annotated[tuple[float, float], "x, y on the mirror in mm"]

_MOST_ROUNDS = 5
_SETTLED_SHARE = 1e-6
"""Heights wrong by this part of the camera's distance turn slopes by about 0.1 urad."""

DEFAULT_FOCAL_MM = 1e5
"""Nearly flat: where a parabola starts if nothing else is said."""


class SlopesParams(Params):
    """Where the mirror stands, and what it should be."""

    pose: PoseFrom | None = setting(None, title="Mirror's pose", auto="pose_from")
    """given: with the rig's calibration; outline: from the edge of the mirror's pixels; markers: from points on it.
    Automatic: markers if there are some, else as given, else the outline."""
    outline_mm: tuple[Corner, ...] | None = setting(
        None, title="Mirror's corners", unit="mm", max_length=200
    )
    """x, y of each corner in order, in the mirror's frame: x right, y up as seen from its front."""
    diameter_mm: float | None = setting(None, title="Round mirror's diameter", unit="mm", gt=0)
    markers: tuple[Marker, ...] | None = setting(None, title="Markers", max_length=200)
    """Column and row in the picture, then x, y, z on the mirror, of at least four points."""
    start: Literal["plane", "parabola"] = setting("plane", title="Start from")
    """Surface that the search starts from; the result doesn't depend on it."""
    align: bool | None = setting(None, title="Turn to the design", auto="aligned")
    """Turn the mirror so that the measured normal in its middle is the design's: the pose then needn't be exact.
    Automatic: unless the pose is given."""
    middle_mm: Corner = setting((0.0, 0.0), title="Turned about", unit="mm", advanced=True)
    screen_distance_mm: float | None = setting(
        None, title="Distance to the screen's origin", unit="mm", gt=0
    )
    """Measured; the mirror is moved on the camera's line of sight until it fits. None: as the pose says."""
    measured_mm: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0), title="Distance measured from", unit="mm", advanced=True
    )
    """Point of the mirror, in its frame."""
    order: int = setting(2, title="Order of the surface", ge=2, le=10)
    """Polynomial that stands for the surface while slopes are found; 2 is a paraboloid. More for freeforms."""
    robust: bool = setting(True, title="Fit robustly", advanced=True)
    """Pixels that don't fit the surface, as at edges and dirt, don't count in it."""
    design: Design = setting("fit", title="Design shape")
    """What errors are counted against. fit: the best paraboloid; map: a height map."""
    focal_x_mm: float | None = setting(None, title="Design focal length, x", unit="mm")
    """Of a parabola; negative is convex."""
    focal_y_mm: float | None = setting(None, title="Design focal length, y", unit="mm")
    """None: as in x."""
    height_map: ArrayHash | None = setting(None, title="Design height map")
    """Heights in mm, rows from the top (largest y) down, its middle in the mirror's middle."""
    height_map_pitch_mm: float = setting(1.0, title="Pitch of the height map", unit="mm", gt=0)
    curvature_px: float = setting(2.0, title="Smoothing of the curvature", unit="px", gt=0, le=50)


@dataclass(frozen=True)
class Slopes:
    """Slopes of the mirror, in its own frame: x right and y up as seen from its front, z towards the viewer."""

    slope_x_mrad: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]],
        Picture("Slope, x", unit="mrad", colormap="turbo"),
    ]
    """dz/dx; NaN where unknown."""
    slope_y_mrad: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]],
        Picture("Slope, y", unit="mrad", colormap="turbo"),
    ]
    error_x_mrad: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]],
        Picture("Slope error, x", unit="mrad", colormap="turbo"),
    ]
    """Measured less design."""
    error_y_mrad: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]],
        Picture("Slope error, y", unit="mrad", colormap="turbo"),
    ]
    curvature_per_m: Annotated[
        Mapping[str, Float32[np.ndarray, "_h _w"]],
        Picture("Curvature", unit="1/m", colormap="turbo"),
    ]
    """Mean of the second derivatives, 1/(2 f)."""
    focal_x_m: Annotated[float, Value("Focal length, x", unit="m", digits=5)]
    focal_y_m: Annotated[float, Value("Focal length, y", unit="m", digits=5)]
    rms_x_mrad: Annotated[float, Value("Slopes, x, rms", unit="mrad")]
    rms_y_mrad: Annotated[float, Value("Slopes, y, rms", unit="mrad")]
    error_rms_mrad: Annotated[float, Value("Slope error, rms", unit="mrad")]
    """Over both directions."""
    valid_share: Annotated[float, Value("Pixels with slopes")]
    """Of those with a place on the screen."""
    pose_from: Annotated[str, Value("Mirror's pose")]
    aligned: Annotated[bool, Value("Turned to the design")]
    tilt_mrad: Annotated[float, Value("Turned by", unit="mrad")]
    points_mm: Mapping[str, Float32[np.ndarray, "_h _w 3"]]
    """Where each pixel's ray meets the surface, in the mirror's frame."""
    design_mm: Mapping[str, Float32[np.ndarray, "_h _w"]]
    """Height of the design there."""
    mirror: Mapping[str, Bool[np.ndarray, "_h _w"]]
    """Pixels of the mirror, valid or not."""
    coefficients: Float64[np.ndarray, "_terms"]
    """The surface as a polynomial in mm: 1 x x^2 y xy y^2 for order 2."""
    mirror_from_camera: Pose
    camera: str


def _covered(result: Slopes, params: SlopesParams) -> Check:
    return at_least(
        "slopes", result.valid_share, warning=0.98, failure=0.01,
        sentence=f"{result.valid_share:.1%} of the pixels with a place on the screen have slopes",
        remedy="check the screen's grid and the mirror's pose",
    )  # fmt: skip


def _turned(result: Slopes, params: SlopesParams) -> Check:
    if not result.aligned:
        return Check("pose", Level.OK, f"pose {result.pose_from}")
    level = Level.OK if result.tilt_mrad < 100 else Level.WARNING
    sentence = f"pose from {result.pose_from}, turned by {result.tilt_mrad:.1f} mrad to the design's normal"
    return Check("pose", level, sentence, result.tilt_mrad, 100.0, "mrad")


@stage(title="Slopes", version=1, review=Review.ON_WARNING, checks=(_covered, _turned))
def slopes(
    phase: ScreenPhase,
    calibration: RigCalibration,
    params: SlopesParams,
    load: LoadArray,
    progress: Progress,
) -> Slopes:
    """Halve the angle between camera and screen at every point of the mirror: its normal."""
    try:
        scene = _Scene.of(phase, calibration)
        pose, pose_from = scene.pose(params)
        progress(0.2, "surface and slopes in turn")
        aligned = params.align if params.align is not None else pose_from != "given"
        found = solve_slopes(
            scene.view,
            pose,
            _start(params),
            order=params.order,
            robust=params.robust,
            alignment=scene.alignment(params, aligned, load),
        )
        progress(0.5, "the surface beyond the polynomial")
        found = scene.follow(found)
        progress(0.8, "errors and curvature")
        design = _design(params, found, load)
    except ScreenError as error:
        raise InvalidCalibrationError(sentence_of(error)) from error
    except NumericsError as error:
        raise StageFailedError(sentence_of(error)) from error
    return _describe(scene, found, design, pose_from, aligned, params)


@dataclass(frozen=True)
class _Scene:
    """What the reference camera sees, and where."""

    camera: str
    model: Pinhole
    places: Bool[np.ndarray, "h w"]
    """Pixels with a place on the screen."""
    mirror: Bool[np.ndarray, "h w"]
    view: View
    screen: ScreenSurface
    camera_from_screen: RigidTransform
    mirror_from_camera: RigidTransform | None

    @classmethod
    def of(cls, phase: ScreenPhase, calibration: RigCalibration) -> "_Scene":
        """Collect it, or say what is missing."""
        name = calibration.reference
        model = require_camera(calibration, name)
        for axis, periods in (("x", phase.periods_x), ("y", phase.periods_y)):
            if not periods:
                raise StageFailedError(
                    f"There are no fringes along {axis}: slopes need places on the screen in x and y."
                )
            check_periods(periods)
        if name not in phase.share_x or name not in phase.share_y:
            raise StageFailedError(
                f"There are no fringes of the reference camera {name!r}: capture them with it too."
            )
        if calibration.screen is None or calibration.screen_from_world is None:
            raise StageFailedError(
                "The rig's calibration has no screen: slopes need its shape and its pose."
            )
        u, v = phase.share_x[name], phase.share_y[name]
        if u.shape != (model.height_px, model.width_px):
            raise InvalidCalibrationError(
                f"The pictures of camera {name!r} are {u.shape[1]}x{u.shape[0]} px, but it was calibrated at "
                f"{model.width_px}x{model.height_px} px: calibrate it at the size in use."
            )
        places = np.isfinite(u) & np.isfinite(v)
        surface = screen_surface(calibration.screen.shares, calibration.screen.points_mm)
        to_camera = _inverse(from_reference(calibration, calibration.screen_from_world))
        shares = np.stack([u[places], v[places]], axis=1).astype(np.float64)
        screen_mm = surface.points(shares) @ to_camera.R.T + to_camera.t_mm
        y, x = np.nonzero(places)
        directions = np.ones((x.size, 3))
        directions[:, :2] = rays(np.stack([x, y], axis=1).astype(np.float64), model)
        mirror = calibration.mirror_from_world
        return cls(
            camera=name,
            model=model,
            places=places,
            mirror=phase.mirror[name] > 0,
            view=View(directions, screen_mm, to_camera.t_mm),
            screen=surface,
            camera_from_screen=to_camera,
            mirror_from_camera=None if mirror is None else from_reference(calibration, mirror),
        )

    def pose(self, params: SlopesParams) -> tuple[RigidTransform, PoseFrom]:
        """Return mirror_from_camera and where it is from."""
        chosen = params.pose or self._automatic(params)
        if chosen == "markers":
            if not params.markers:
                raise InvalidSettingError("A pose from markers needs markers: name at least four.")
            table = np.array(params.markers, np.float64)
            return pose_from_markers(table[:, :2], table[:, 2:], self.model), "markers"
        if chosen == "given":
            if self.mirror_from_camera is None:
                raise InvalidSettingError(
                    "The rig's calibration has no pose of the mirror: choose its outline or markers."
                )
            return self.mirror_from_camera, "given"
        return self._from_outline(params), "outline"

    def _automatic(self, params: SlopesParams) -> PoseFrom:
        if params.markers:
            return "markers"
        return "given" if self.mirror_from_camera is not None else "outline"

    def _from_outline(self, params: SlopesParams) -> RigidTransform:
        if params.outline_mm:
            outline = np.array(params.outline_mm, np.float64)
        elif params.diameter_mm is not None:
            outline = circle_outline(params.diameter_mm)
        else:
            raise InvalidSettingError(
                "Nothing says where the mirror is: give its corners or its diameter, markers on it, or its pose "
                "with the rig's calibration."
            )
        to_camera = self.camera_from_screen
        middle = to_camera.R @ self.screen.middle_mm + to_camera.t_mm
        return pose_from_outline(self.mirror, outline, self.model, middle)

    def spread(self, values: Float[np.ndarray, "n"]) -> Float64[np.ndarray, "h w"]:
        """Put values of the pixels with a place on the screen into a map."""
        full = np.full(self.places.shape, np.nan)
        full[self.places] = values
        return full

    def follow(self, found: MirrorSlopes) -> MirrorSlopes:
        """Integrate what the polynomial leaves and move the points there, until that changes nothing."""
        deviation_mm = np.zeros(len(found.points_mm))
        settled_mm = _SETTLED_SHARE * float(np.linalg.norm(found.mirror_from_world.t_mm))
        for _ in range(_MOST_ROUNDS):
            x, y = found.points_mm[:, 0], found.points_mm[:, 1]
            rest = found.slopes - found.fit.slopes(x, y)
            parts = (x, y, rest[:, 0], rest[:, 1])
            height = integrate_slopes(*map(self.spread, parts), tolerance=1e-4).height_mm
            before, deviation_mm = deviation_mm, height[self.places]
            # Slopes don't tell heights: the surface goes through the polynomial where the mirror's origin is.
            deviation_mm = deviation_mm - deviation_mm[np.nanargmin(np.hypot(x, y))]
            if np.nanmax(np.abs(deviation_mm - before)) < settled_mm:
                break
            found = follow_deviation(self.view, found, deviation_mm)
        return found

    def alignment(self, params: SlopesParams, aligned: bool, load: LoadArray) -> Alignment | None:
        """Say what of the pose is adjusted."""
        if not aligned:
            return None
        middle = np.array(params.middle_mm, np.float64)
        return Alignment(
            middle,
            _slopes_at_middle(params, load),
            params.screen_distance_mm,
            np.array(params.measured_mm, np.float64),
        )


def _inverse(transform: RigidTransform) -> RigidTransform:
    return RigidTransform(transform.R.T, -transform.R.T @ transform.t_mm)


def _start(params: SlopesParams) -> Surface:
    if params.start == "plane":
        return plane()
    focal_x_mm = params.focal_x_mm or DEFAULT_FOCAL_MM
    return paraboloid(focal_x_mm, params.focal_y_mm or focal_x_mm)


def _design_surface(params: SlopesParams) -> Surface:
    """Return the design where it is a formula."""
    if params.design == "plane":
        return plane()
    if params.focal_x_mm is None:
        raise InvalidSettingError("A parabola as design needs its focal length: give it in x.")
    return paraboloid(params.focal_x_mm, params.focal_y_mm or params.focal_x_mm)


def _design_map(params: SlopesParams, load: LoadArray) -> HeightGrid:
    if params.height_map is None:
        raise InvalidSettingError("A height map as design needs one: hand it over.")
    return HeightGrid.of(load(params.height_map), params.height_map_pitch_mm)


def _slopes_at_middle(params: SlopesParams, load: LoadArray) -> Float64[np.ndarray, "2"]:
    x, y = np.array(params.middle_mm[:1]), np.array(params.middle_mm[1:])
    if params.design == "fit":
        return np.zeros(2)
    if params.design == "map":
        found = _design_map(params, load).slopes(x, y)[0]
        return np.asarray(np.nan_to_num(found))
    return np.asarray(_design_surface(params).slopes(x, y)[0])


def _design(params: SlopesParams, found: MirrorSlopes, load: LoadArray) -> Surface | HeightGrid:
    """Return what errors are counted against."""
    if params.design == "map":
        return _design_map(params, load)
    return (
        Surface(second_order(found.fit.coefficients))
        if params.design == "fit"
        else _design_surface(params)
    )


def second_order(coefficients: Float[np.ndarray, "terms"]) -> Float64[np.ndarray, "6"]:
    """Return the coefficients of 1 x x^2 y xy y^2 among those of any order."""
    order = Surface(coefficients).order
    places = [0, 1, 2, order + 1, order + 2, 2 * order + 1]
    return np.asarray(coefficients[places], np.float64)


def _describe(
    scene: _Scene,
    found: MirrorSlopes,
    design: Surface | HeightGrid,
    pose_from: PoseFrom,
    aligned: bool,
    params: SlopesParams,
) -> Slopes:
    spread = scene.spread
    points = np.full((*scene.places.shape, 3), np.nan, np.float32)
    points[scene.places] = found.points_mm
    slope_x, slope_y = spread(found.slopes[:, 0]), spread(found.slopes[:, 1])
    x_mm, y_mm = spread(found.points_mm[:, 0]), spread(found.points_mm[:, 1])
    x, y = found.points_mm[:, 0], found.points_mm[:, 1]
    error = found.slopes - design.slopes(x, y)
    valid = np.isfinite(found.slopes).all(axis=1)
    bent = curvature(x_mm, y_mm, slope_x, slope_y, sigma_px=params.curvature_px)
    shape = second_order(found.fit.coefficients)
    name = scene.camera
    return Slopes(
        slope_x_mrad={name: (1e3 * slope_x).astype(np.float32)},
        slope_y_mrad={name: (1e3 * slope_y).astype(np.float32)},
        error_x_mrad={name: (1e3 * spread(error[:, 0])).astype(np.float32)},
        error_y_mrad={name: (1e3 * spread(error[:, 1])).astype(np.float32)},
        curvature_per_m={name: (1e3 * bent.mean).astype(np.float32)},
        focal_x_m=_focal_m(shape[2]),
        focal_y_m=_focal_m(shape[5]),
        rms_x_mrad=_rms_mrad(found.slopes[valid, 0]),
        rms_y_mrad=_rms_mrad(found.slopes[valid, 1]),
        error_rms_mrad=_rms_mrad(error[np.isfinite(error)]),
        valid_share=float(valid.mean()),
        pose_from=pose_from,
        aligned=aligned,
        tilt_mrad=1e3 * found.tilt_rad,
        points_mm={name: points},
        design_mm={name: spread(design.heights(x, y)).astype(np.float32)},
        mirror={name: scene.mirror},
        coefficients=found.fit.coefficients,
        mirror_from_camera=Pose(found.mirror_from_world.R, found.mirror_from_world.t_mm),
        camera=name,
    )


def _focal_m(second: float) -> float:
    """Return 1/(4 c) in [m] for z = c x^2 in [mm]; infinite for a plane."""
    return float(0.25e-3 / second) if second else float("inf")


def _rms_mrad(values: Float[np.ndarray, "n"]) -> float:
    return float(1e3 * np.sqrt(np.mean(values**2))) if values.size else float("nan")
