"""A rig in 3D: cameras and projector where their calibration says, with what they see."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import viser
from numpy.typing import NDArray

from app.palette import CAMERAS, PROJECTOR, rgb
from backend.contract.rigs import PinholeView, PoseView, RigView

Array = NDArray[Any]

_SIZE_SHARE = 0.24
"""Length of a frustum as a share of the distance to the scene."""


@dataclass(frozen=True)
class Placed:
    """A device with a known place: world_from_device, and how it sees."""

    name: str
    label: str
    R: Array
    centre_mm: Array
    model: PinholeView
    colour: tuple[int, int, int]
    is_camera: bool


def placed_devices(rig: RigView) -> list[Placed]:
    """Return the devices whose pose and model are known; a camera without a pose is the world's origin if it is the reference."""
    found = []
    for i, camera in enumerate(rig.cameras):
        pose = camera.camera_from_world
        if pose is None and camera.name == rig.reference:
            pose = PoseView(R=((1, 0, 0), (0, 1, 0), (0, 0, 1)), t_mm=(0, 0, 0))
        if camera.model is not None and pose is not None:
            colour = rgb(CAMERAS[i % len(CAMERAS)])
            found.append(
                _placed(camera.name, camera.name, pose, camera.model, colour, is_camera=True)
            )
    projector = rig.projector
    if projector is not None and projector.model and projector.projector_from_world:
        found.append(
            _placed(
                "projector ",
                "projector",
                projector.projector_from_world,
                projector.model,
                rgb(PROJECTOR),
                is_camera=False,
            )
        )
    return found


def mirror_of(rig: RigView | None) -> Array | None:
    """Return the middle of the mirror under test; None where there is none."""
    return None if rig is None or rig.mirror_mm is None else np.array(rig.mirror_mm)


def _placed(
    name: str,
    label: str,
    pose: PoseView,
    model: PinholeView,
    colour: tuple[int, int, int],
    *,
    is_camera: bool,
) -> Placed:
    R = np.array(pose.R, dtype=np.float64)
    return Placed(
        name, label, R.T, -R.T @ np.array(pose.t_mm, dtype=np.float64), model, colour, is_camera
    )


def aim_mm(devices: list[Placed], mirror_mm: Array | None = None) -> tuple[Array, Array]:
    """Return where the cameras look at, and the mean direction they look in.

    One camera alone (or parallel ones) looks at the mirror, or at 500 mm: a guess that only places the view.
    """
    cameras = [d for d in devices if d.is_camera] or devices
    axes = np.array([d.R[:, 2] for d in cameras])
    centres = np.array([d.centre_mm for d in cameras])
    direction = axes.mean(axis=0)
    direction /= np.linalg.norm(direction)
    if mirror_mm is not None:
        return mirror_mm, direction
    # The point nearest to all axes: sum over (1 - a a^T) (x - c) = 0.
    across = np.eye(3)[None] - axes[:, :, None] * axes[:, None, :]
    system, right = across.sum(axis=0), np.einsum("nij,nj->i", across, centres)
    if np.linalg.cond(system) < 1e6:
        point = np.linalg.solve(system, right)
        if (point - centres.mean(axis=0)) @ direction > 0:
            return point, direction
    return centres.mean(axis=0) + 500.0 * direction, direction


class FrustumsView:
    """The devices of one rig under a scene node.

    Parameters
    ----------
    scene
        Of one browser.
    parent
        Node that turns the rig's world into the scene's.
    unit
        Scene units per mm.
    rig
        What else is drawn: its screen, and the mirror that cameras look at.
    """

    def __init__(
        self,
        scene: viser.SceneApi,
        parent: str,
        devices: list[Placed],
        *,
        unit: float,
        rig: RigView | None = None,
    ) -> None:
        aim, _ = aim_mm(devices, mirror_of(rig))
        self._handles: dict[str, Any] = {}
        self._nodes: list[Any] = []
        for device in devices:
            distance = float(np.linalg.norm(aim - device.centre_mm))
            self._add(scene, f"{parent}/rig/{device.name.strip()}", device, distance, unit)
        if rig is not None and rig.screen_mm:
            self._add_screen(scene, f"{parent}/rig/screen ", unit * np.array(rig.screen_mm))

    @property
    def cameras(self) -> list[str]:
        """Names of the cameras that stand in the scene."""
        return list(self._handles)

    def handle(self, camera: str) -> Any:
        """Return a camera's frustum, None if it has no place."""
        return self._handles.get(camera)

    def show_picture(self, camera: str, jpeg: bytes) -> None:
        """Show what a camera sees."""
        handle = self._handles.get(camera)
        picture = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
        if handle is None or picture is None:
            return
        handle.image = cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)

    def set_visible(self, visible: bool) -> None:
        """Show or hide all."""
        for node in self._nodes:
            node.visible = visible

    def remove(self) -> None:
        """Take everything out of the scene."""
        for node in self._nodes:
            node.remove()
        self._nodes, self._handles = [], {}

    def _add_screen(self, scene: viser.SceneApi, node: str, edge: Array) -> None:
        ways = np.stack([edge, np.roll(edge, -1, axis=0)], axis=1)
        colour = np.array(rgb(PROJECTOR), np.uint8)
        lines = scene.add_line_segments(node, ways, colour, thickness=1.6, thickness_units="screen")
        # The first corner is the pattern's: upper left as the mirror sees the screen.
        label = scene.add_label(
            f"{node}/label",
            "screen",
            anchor="bottom-center",
            font_screen_scale=0.95,
            position=edge[0],
        )
        self._nodes += [label, lines]

    def _add(
        self, scene: viser.SceneApi, node: str, device: Placed, distance_mm: float, unit: float
    ) -> None:
        model = device.model
        fov = 2.0 * float(np.arctan(0.5 * model.height_px / model.K[1][1]))
        wxyz = viser.transforms.SO3.from_matrix(device.R).wxyz
        centre = device.centre_mm * unit
        frustum = scene.add_camera_frustum(
            node, fov, model.width_px / model.height_px, scale=_scale(fov, model.width_px / model.height_px, _SIZE_SHARE * distance_mm * unit), thickness=1.6,
            thickness_units="screen", color=device.colour, wxyz=wxyz, position=centre, format="jpeg", jpeg_quality=80,
            cast_shadow=False, receive_shadow=False,
        )  # fmt: skip
        label = scene.add_label(
            f"{node}/label", device.label, anchor="bottom-center", font_screen_scale=0.95
        )
        end = np.array([0.0, 0.0, distance_mm * unit * 0.93])
        axis = scene.add_line_segments(
            f"{node}/axis",
            np.array([[[0.0, 0.0, 0.0], end]]),
            np.array(device.colour, np.uint8),
            thickness=0.8,
            thickness_units="screen",
        )
        self._nodes += [label, axis, frustum]
        if device.is_camera:
            self._handles[device.name] = frustum


def _scale(fov_rad: float, aspect: float, length: float) -> float:
    """Return viser's scale of a frustum that is so long: it takes the cube root of the frustum's volume."""
    half = np.tan(fov_rad / 2)
    return float(length * np.cbrt(half * half * aspect / 3.0))
