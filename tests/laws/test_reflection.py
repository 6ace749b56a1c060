"""Mirrors by geometry: reflection in closed form, integration, pose and curvature."""

import numpy as np
import pytest

from backend.numerics.camera_model import Pinhole, RigidTransform, inverse, project, rays
from backend.numerics.deflectometry import (
    Alignment,
    Surface,
    View,
    follow_deviation,
    intersect,
    paraboloid,
    plane,
    reflection_slopes,
    solve_slopes,
)
from backend.numerics.errors import MirrorError, ScreenError
from backend.numerics.height_grid import HeightGrid
from backend.numerics.mirror_pose import circle_outline, pose_from_markers, pose_from_outline
from backend.numerics.polynomial_terms import (
    evaluate,
    fit_terms,
    height_terms,
    slope_terms,
    zernike_list,
    zernike_terms,
)
from backend.numerics.screen_surface import screen_surface
from backend.numerics.slope_integration import integrate_slopes
from backend.numerics.surface_maps import against_surroundings, curvature, smoothed

CAMERA = Pinhole(
    np.array([[700.0, 0, 80], [0, 700, 60], [0, 0, 1]]),
    np.array([-0.1, 0.05, 1e-3, 0, 0]),
    160,
    120,
)


def turn(axis, angle):
    a = np.asarray(axis, float) / np.linalg.norm(axis)
    k = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


FACING = np.diag([1.0, -1.0, -1.0])
"""Mirror's frame before a camera that looks straight at it."""


def rig(surface, *, distance=800.0, tilt=0.15):
    """Trace every pixel: the pose, rays, and points of a screen beside the camera that they end at."""
    pose = RigidTransform(turn([1, 0.3, 0], tilt) @ FACING, np.zeros(3))
    pose = RigidTransform(pose.R, -pose.R @ np.array([10.0, -20.0, distance]))
    y, x = np.mgrid[:120, :160]
    directions = np.ones((x.size, 3))
    directions[:, :2] = rays(np.stack([x.ravel(), y.ravel()], axis=1).astype(float), CAMERA)
    points = intersect(pose.t_mm, directions @ pose.R.T, surface)
    slopes = surface.slopes(points[:, 0], points[:, 1])
    normals = np.column_stack([-slopes, np.ones(len(slopes))])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    inwards = points - pose.t_mm
    inwards /= np.linalg.norm(inwards, axis=1, keepdims=True)
    outwards = inwards - 2 * (inwards * normals).sum(axis=1)[:, None] * normals
    # The screen: z = 900 mm of the mirror's frame.
    screen = points + ((900.0 - points[:, 2]) / outwards[:, 2])[:, None] * outwards
    world = inverse(pose)
    view = View(directions, screen @ world.R.T + world.t_mm, world.R @ [0, 0, 900.0] + world.t_mm)
    return view, pose, points, slopes


class TestReflection:
    def test_a_ray_from_a_parabolas_focus_leaves_along_its_axis(self):
        focal_mm = 500.0
        mirror = paraboloid(focal_mm, focal_mm)
        x, y = (
            a.ravel() for a in np.meshgrid(np.linspace(-200, 200, 9), np.linspace(-150, 150, 7))
        )
        points = np.column_stack([x, y, mirror.heights(x, y)])
        far = points + np.array([0.0, 0.0, 700.0])
        slopes = reflection_slopes(points, np.array([0.0, 0.0, focal_mm]), far)
        assert np.allclose(slopes, mirror.slopes(x, y), atol=1e-12)

    def test_a_plane_shows_the_mirror_image(self):
        camera, image = np.array([30.0, 10.0, 400.0]), np.array([30.0, 10.0, -400.0])
        points = np.column_stack([np.linspace(-90, 90, 20), np.linspace(50, -50, 20), np.zeros(20)])
        screen = points + 1.7 * (points - image)
        assert np.abs(reflection_slopes(points, camera, screen)).max() < 1e-12

    @pytest.mark.parametrize(
        "surface",
        [plane(), paraboloid(600, 400), paraboloid(-2000, 900), Surface(np.array([1.0, 0.02, 1e-4, -0.01, 2e-5, 2e-4]))],
    )  # fmt: skip
    def test_intersections_lie_on_ray_and_surface(self, surface):
        rng = np.random.default_rng(2)
        origin = np.array([20.0, -40.0, 700.0])
        directions = np.column_stack([rng.uniform(-0.15, 0.15, (500, 2)), -np.ones(500)])
        points = intersect(origin, directions, surface)
        assert np.abs(points[:, 2] - surface.heights(points[:, 0], points[:, 1])).max() < 1e-9
        assert np.abs(np.cross(points - origin, directions)).max() < 1e-6

    def test_rays_that_miss_are_nan(self):
        upwards = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
        found = intersect(np.array([0.0, 0.0, 100.0]), upwards, plane())
        assert np.isnan(found[:2]).all()
        assert np.isfinite(found[2]).all()


class TestSolving:
    @pytest.mark.parametrize(
        ("surface", "order"),
        [
            (plane(), 2),
            (paraboloid(1200, 800), 2),
            (paraboloid(-3000, 5000), 2),
            (Surface(np.array([0.0, 0, 2e-4, 1e-7, 0, 1e-5, 0, 2e-4, 0, -2e-7])), 3),
        ],
    )
    @pytest.mark.parametrize("start", [plane(), paraboloid(2000, 2000)])
    def test_slopes_and_surface_are_recovered(self, surface, order, start):
        view, pose, points, slopes = rig(surface)
        found = solve_slopes(view, pose, start, order=order, robust=False)
        assert np.abs(found.slopes - slopes).max() < 2e-9
        assert np.abs(found.points_mm - points).max() < 1e-5

    def test_alignment_undoes_tilt_and_distance(self):
        surface = paraboloid(1200, 800)
        view, pose, _points, slopes = rig(surface)
        pivot = pose.t_mm
        wrong = RigidTransform(
            turn([1, -1, 0], 0.03) @ pose.R, 1.02 * turn([1, -1, 0], 0.03) @ pivot
        )
        distance = float(np.linalg.norm(pose.R @ view.screen_origin_mm + pose.t_mm))
        found = solve_slopes(
            view, wrong, plane(), alignment=Alignment(np.zeros(2), np.zeros(2), distance)
        )
        assert np.abs(found.slopes - slopes).max() < 5e-6  # a twist about the normal stays
        assert found.fit.coefficients[2] == pytest.approx(0.25 / 1200, rel=1e-5)
        assert found.fit.coefficients[5] == pytest.approx(0.25 / 800, rel=1e-5)
        assert found.tilt_rad == pytest.approx(0.03, rel=1e-3)

    def test_dirt_does_not_bend_a_robust_fit(self):
        surface = paraboloid(1200, 800)
        view, pose, *_ = rig(surface)
        view.screen_mm[::17] += [30.0, -20.0, 5.0]
        found = solve_slopes(view, pose, plane())
        assert found.fit.coefficients[2] == pytest.approx(0.25 / 1200, rel=1e-6)

    def test_points_follow_what_no_paraboloid_is(self):
        bump = Surface(np.array([0.0, 0, 2e-4, 1e-6, 0, 1e-5, 0, 2e-4, 0, -2e-6]))
        view, pose, points, slopes = rig(bump)
        found = solve_slopes(view, pose, plane(), robust=False)
        before = np.abs(found.slopes - slopes).max()
        for _ in range(3):
            x, y = points[:, 0], points[:, 1]
            found = follow_deviation(view, found, bump.heights(x, y) - found.fit.heights(x, y))
        assert np.abs(found.slopes - slopes).max() < 0.02 * before

    def test_too_few_rays_are_refused(self):
        view, pose, *_ = rig(plane())
        view.screen_mm[5:] = np.nan
        with pytest.raises(MirrorError, match="only 5 of 19200 pixels"):
            solve_slopes(view, pose, plane())

    def test_an_impossible_distance_is_refused(self):
        view, pose, *_ = rig(plane())
        with pytest.raises(MirrorError, match="measure the distance again"):
            solve_slopes(view, pose, plane(), alignment=Alignment(np.zeros(2), np.zeros(2), 1.0))


def holed(height, width):
    """A mask with a curved edge, a hole, and an island."""
    y, x = np.mgrid[:height, :width]
    mask = np.hypot((x - width / 2) / width, (y - height / 2) / height) < 0.4
    mask &= np.hypot(x - 0.6 * width, y - 0.4 * height) > 0.1 * width
    mask[: height // 10, : width // 8] = True
    return mask


class TestIntegration:
    @pytest.mark.parametrize("size", [(9, 7), (60, 81), (200, 150)])
    def test_surfaces_of_second_order_come_out_exactly(self, size):
        mask = holed(*size)
        v, u = np.mgrid[: size[0], : size[1]].astype(float)
        x, y = 0.3 * u + 0.02 * v, -0.31 * v + 1e-3 * u * v / size[0]
        surface = Surface(np.array([0.0, 0.1, 2e-3, -0.2, 1e-3, 3e-3]))
        slopes = surface.slopes(x.ravel(), y.ravel()).T.reshape(2, *size)
        slopes[:, ~mask] = np.nan
        found = integrate_slopes(x, y, slopes[0], slopes[1], tolerance=1e-12)
        truth = surface.heights(x.ravel(), y.ravel()).reshape(size)
        assert np.array_equal(np.isfinite(found.height_mm), mask)
        import cv2

        count, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
        for label in range(1, count):
            off = (found.height_mm - truth)[labels == label]
            assert np.ptp(off) < 1e-8
            assert abs(found.height_mm[labels == label].mean()) < 1e-9
        assert found.misfit_mm < 1e-9

    def test_rounds_hardly_depend_on_the_size(self):
        rounds = []
        for n in (32, 128, 512):
            y, x = np.mgrid[:n, :n] / n
            slopes = np.where(holed(n, n), np.sin(6 * x) * y, np.nan)
            rounds.append(integrate_slopes(x, y, slopes, slopes).rounds)
        assert max(rounds) <= 2 * min(rounds) <= 60

    def test_noise_of_slopes_becomes_little_noise_of_heights(self):
        rng = np.random.default_rng(3)
        y, x = np.mgrid[:128, :128].astype(float)
        noise = 1e-5 * rng.standard_normal((2, 128, 128))
        found = integrate_slopes(x, y, *noise)
        assert found.height_mm.std() < 2e-5
        # A step's misfit: mean of two slopes, less what the surface takes of it.
        assert found.misfit_mm == pytest.approx(1e-5 / np.sqrt(2), rel=0.5)

    def test_nothing_valid_is_nothing(self):
        empty = np.full((8, 8), np.nan)
        found = integrate_slopes(empty, empty, empty, empty)
        assert np.isnan(found.height_mm).all()
        assert np.isnan(found.misfit_mm)


class TestPose:
    POSE = RigidTransform(turn([0.6, 1, 0.1], 0.2) @ FACING, np.zeros(3))

    def mirror_from_camera(self):
        return RigidTransform(self.POSE.R, -self.POSE.R @ np.array([5.0, -8.0, 900.0]))

    def picture(self, corners):
        """Pixels whose centre's ray meets the mirror's plane within the polygon."""
        pose = self.mirror_from_camera()
        y, x = np.mgrid[:120, :160]
        slopes = rays(np.stack([x.ravel(), y.ravel()], axis=1).astype(float), CAMERA)
        along = np.column_stack([slopes, np.ones(len(slopes))]) @ pose.R.T
        at = pose.t_mm[:2] - (pose.t_mm[2] / along[:, 2])[:, None] * along[:, :2]
        sides = np.roll(corners, -1, axis=0) - corners
        offset = at[:, None] - corners
        turning = sides[:, 0] * offset[..., 1] - sides[:, 1] * offset[..., 0]
        inside = (turning > 0).all(axis=1) | (turning < 0).all(axis=1)
        return inside.reshape(120, 160)

    def screen_middle(self):
        """Where a screen has to be for this mirror to be in its camera's view."""
        truth = inverse(self.mirror_from_camera())
        normal = truth.R[:, 2]
        to_camera = -truth.t_mm / np.linalg.norm(truth.t_mm)
        return truth.t_mm + 800 * (2 * (normal @ to_camera) * normal - to_camera)

    @pytest.mark.parametrize(
        "outline",
        [
            np.array([[-70.0, -50], [70, -50], [70, 50], [-70, 50]]),
            np.array([[70.0, 50], [70, -50], [-70, -50], [-70, 50]]),
            np.array([[-60.0, -50], [65, -45], [0, 60]]),
            circle_outline(130.0),
        ],
    )
    def test_the_outline_tells_the_pose(self, outline):
        found = pose_from_outline(self.picture(outline), outline, CAMERA, self.screen_middle())
        truth = self.mirror_from_camera()
        middle = inverse(found).t_mm - inverse(truth).t_mm
        assert np.linalg.norm(middle[:2]) < 1.5
        assert abs(middle[2]) < 12
        assert np.arccos(np.clip(found.R[2] @ truth.R[2], -1, 1)) < 0.06

    def test_markers_tell_the_pose(self):
        markers = np.array([[-70.0, -50, 0], [70, -50, 0], [70, 50, 5], [-70, 50, 0], [0, 0, 2]])
        truth = self.mirror_from_camera()
        pixels = project(markers, CAMERA, inverse(truth))
        found = pose_from_markers(pixels, markers, CAMERA)
        assert np.allclose(found.R, truth.R, atol=1e-6)
        assert np.allclose(found.t_mm, truth.t_mm, atol=1e-3)

    def test_what_tells_no_pose_is_refused(self):
        square = np.array([[-70.0, -50], [70, -50], [70, 50], [-70, 50]])
        empty, full = np.zeros((120, 160), bool), np.ones((120, 160), bool)
        screen = np.array([0.0, -300, 0])
        with pytest.raises(MirrorError, match="no pixel sees the mirror"):
            pose_from_outline(empty, square, CAMERA, screen)
        with pytest.raises(MirrorError, match="cut by the picture's border"):
            pose_from_outline(full, square, CAMERA, screen)
        with pytest.raises(MirrorError, match="at least three"):
            pose_from_outline(self.picture(square), square[:2], CAMERA, screen)
        with pytest.raises(MirrorError, match="at least four"):
            pose_from_markers(np.zeros((3, 2)), np.zeros((3, 3)), CAMERA)
        markers = np.array([[-70.0, -50, 0], [70, -50, 0], [70, 50, 0], [-70, 50, 0]])
        pixels = project(markers, CAMERA, inverse(self.mirror_from_camera()))[[0, 2, 1, 3]]
        with pytest.raises(MirrorError, match="check their order"):
            pose_from_markers(pixels, markers, CAMERA)


class TestScreen:
    def test_four_corners_are_a_flat_screen(self):
        corners = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
        screen = screen_surface(corners, np.column_stack([500 * corners, np.zeros(4)]))
        found = screen.points(np.array([[0.5, 0.25], [0.0, 1.0], [1.3, 0.5], [np.nan, 0.5]]))
        assert np.allclose(found[:2], [[250, 125, 0], [0, 500, 0]])
        assert np.isnan(found[2:]).all()
        assert np.allclose(screen.middle_mm, [250, 250, 0])

    def test_a_measured_grid_is_interpolated(self):
        shares = np.stack(np.meshgrid(np.linspace(0, 1, 21), np.linspace(0, 1, 21)), -1).reshape(
            -1, 2
        )

        def bent(s):
            return np.column_stack([400 * s[:, 0], 300 * s[:, 1], 8 * (s[:, 0] - 0.5) ** 2])

        screen = screen_surface(shares, bent(shares))
        asked = np.random.default_rng(4).uniform(0, 1, (300, 2))
        assert np.abs(screen.points(asked) - bent(asked)).max() < 8 * 0.05**2 / 4 + 1e-9
        assert np.isnan(screen.points(np.array([[1.2, 0.5]]))).all()

    def test_what_is_no_screen_is_refused(self):
        corners = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
        points = np.column_stack([corners, np.zeros(4)])
        with pytest.raises(ScreenError, match="screen of 2 points"):
            screen_surface(corners[:2], points[:2])
        with pytest.raises(ScreenError, match="one line"):
            screen_surface(corners[[0, 2, 0, 2]], points)
        points[2, 1] = np.nan
        with pytest.raises(
            ScreenError, match=r"1 of 4 points that aren't finite \(the first is number 2"
        ):
            screen_surface(corners, points)


class TestMaps:
    def test_a_paraboloids_curvature_is_its_focal_length(self):
        v, u = np.mgrid[:60, :70].astype(float)
        x, y = 0.5 * u + 0.05 * v, -0.4 * v + 0.002 * u * v / 60
        surface = paraboloid(800, 400)
        slopes = surface.slopes(x.ravel(), y.ravel()).T.reshape(2, 60, 70)
        slopes[:, holed(60, 70) == 0] = np.nan
        found = curvature(x, y, slopes[0], slopes[1])
        inside = np.isfinite(found.mean)
        assert inside.sum() > 0.8 * holed(60, 70).sum()
        assert np.allclose(found.mean[inside], 0.5 * (1 / 1600 + 1 / 800), rtol=2e-3)
        assert np.abs(found.twist[inside]).max() < 2e-6

    def test_smoothing_does_not_bend_a_plane_at_its_edges(self):
        v, u = np.mgrid[:40, :40].astype(float)
        plane_ = np.where(holed(40, 40), 3 * u - 2 * v, np.nan)
        found = smoothed(plane_, sigma_px=3.0)
        known = np.isfinite(found)
        assert known.sum() > 0.9 * np.isfinite(plane_).sum()
        assert np.allclose(found[known], plane_[known], atol=1e-8)

    def test_a_spot_stands_out_and_shading_does_not(self):
        _v, u = np.mgrid[:100, :200].astype(float)
        values = 50 + 0.2 * u
        values[40:44, 100:104] *= 0.7
        found = against_surroundings(values, radius_px=12.0)
        assert found[42, 102] < -0.2
        assert np.abs(found[10:90, 20:90]).max() < 0.03

    def test_terms_are_found_again(self):
        rng = np.random.default_rng(5)
        x, y = rng.uniform(-1, 1, (2, 4000))
        inside = np.hypot(x, y) < 1
        x, y = x[inside], y[inside]
        wanted = rng.standard_normal(len(zernike_list(4)))
        assert np.allclose(
            fit_terms(zernike_terms(x, y, 4), zernike_terms(x, y, 4) @ wanted), wanted
        )
        # Each term has rms 1 over the disc, and they are orthogonal.
        gram = zernike_terms(x, y, 4).T @ zernike_terms(x, y, 4) / x.size
        assert np.abs(gram - np.eye(15)).max() < 0.15
        assert [(t.n, t.m) for t in zernike_list(2)] == [
            (0, 0),
            (1, -1),
            (1, 1),
            (2, -2),
            (2, 0),
            (2, 2),
        ]

    @pytest.mark.parametrize("order", [1, 2, 3, 5])
    def test_polynomials_agree_with_their_terms_and_derivatives(self, order):
        rng = np.random.default_rng(order)
        x, y = rng.uniform(-2, 2, (2, 50))
        coefficients = rng.standard_normal((order + 1) * (order + 2) // 2)
        surface = Surface(coefficients)
        assert np.allclose(evaluate(coefficients, x, y), height_terms(x, y, order) @ coefficients)
        by_x, by_y = slope_terms(x, y, order)
        assert np.allclose(
            surface.slopes(x, y), np.stack([by_x @ coefficients, by_y @ coefficients], 1)
        )

    def test_a_height_map_has_the_slopes_of_its_surface(self):
        y, x = np.meshgrid(np.arange(20, -21, -1.0), np.arange(-30, 31, 1.0), indexing="ij")
        grid = HeightGrid.of(1e-3 * x**2 + 2e-3 * x * y, 1.0)
        at = np.array([4.5, -7.0]), np.array([3.0, 8.25])
        slopes = np.stack([2e-3 * at[0] + 2e-3 * at[1], 2e-3 * at[0]], axis=1)
        assert np.allclose(grid.slopes(*at), slopes, atol=1e-10)
        assert np.allclose(grid.heights(*at), 1e-3 * at[0] ** 2 + 2e-3 * at[0] * at[1], atol=1e-10)
        assert np.isnan(grid.slopes(np.array([40.0]), np.array([0.0]))).all()
        with pytest.raises(MirrorError, match="4 x 4"):
            HeightGrid.of(np.zeros((2, 9)), 1.0)
        with pytest.raises(MirrorError, match="1 heights that aren't finite"):
            HeightGrid.of(np.where(np.eye(5) * [1, 0, 0, 0, 0], np.nan, 0.0), 1.0)
