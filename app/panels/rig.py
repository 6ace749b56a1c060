"""The rig in the scene, with what its cameras see."""

import numpy as np

from app.client import ApiError, picture_address
from app.desk import Desk
from app.look import Look, fields_of_kind
from app.panels.pictures import is_live
from app.space import UNIT, Placement, Space
from app.views.frustums import FrustumsView, Placed, aim_mm, mirror_of, placed_devices
from backend.contract.rigs import RigView

_PICTURE_PX = 512
_NOT_FOUND = 404


class RigPanel:
    """Frustums of one rig; knows which rig is shown and which pictures stand in its frustums."""

    def __init__(self, space: Space, desk: Desk) -> None:
        self._space, self._desk = space, desk
        self._frustums: FrustumsView | None = None
        self._shown_for = ""
        self._pictures: dict[str, str] = {}
        self.rig: RigView | None = None

    @property
    def has_place(self) -> bool:
        """True if at least one camera stands in the scene."""
        return bool(self._frustums and self._frustums.cameras)

    def order_of(self, camera: str) -> int:
        """Return a camera's place among the rig's cameras."""
        names = [c.name for c in self.rig.cameras] if self.rig else []
        return names.index(camera) if camera in names else len(names)

    def draw(self, look: Look) -> None:
        """Show the rig of this scan."""
        if self._shown_for != look.scan.id:
            self.show(self._rig_of(look.scan.id), look.scan.id)

    def draw_pictures(self, look: Look) -> None:
        """Show what its cameras saw last."""
        if self._frustums is None or is_live(look):
            return
        for camera, address in _addresses(look).items():
            if self._pictures.get(camera) != address:
                self._pictures[camera] = address
                self._frustums.show_picture(camera, self._desk.api.picture(address))

    def show(self, rig: RigView | None, shown_for: str) -> None:
        """Show a rig, or none."""
        if self._frustums is not None:
            self._frustums.remove()
        self._frustums, self._pictures = None, {}
        self.rig, self._shown_for = rig, shown_for
        devices = placed_devices(rig) if rig else []
        if devices:
            self._place(devices)
            self._frustums = FrustumsView(
                self._space.scene, self._space.root, devices, unit=UNIT, rig=rig
            )

    def show_live(self, camera: str, jpeg: bytes) -> None:
        """Show the newest picture of a camera."""
        if self._frustums is not None:
            self._pictures.pop(camera, None)
            self._frustums.show_picture(camera, jpeg)

    def _place(self, devices: list[Placed]) -> None:
        aim, direction = aim_mm(devices, mirror_of(self.rig))
        cameras = [d for d in devices if d.is_camera] or devices
        right = np.mean([d.R[:, 0] for d in cameras], axis=0)
        reach = float(np.mean([np.linalg.norm(aim - d.centre_mm) for d in devices])) * UNIT
        self._space.place(Placement.of(-direction, right, aim), reach=reach)
        self._space.view_rig()

    def _rig_of(self, scan_id: str) -> RigView | None:
        try:
            return self._desk.api.rig_of(scan_id)
        except ApiError as error:
            if error.problem.status == _NOT_FOUND:
                return None  # an imported scan may come without one
            raise


def _addresses(look: Look) -> dict[str, str]:
    """Return for each camera the gray picture that was made last."""
    found: dict[str, str] = {}
    for stage in reversed(look.scan.stages):
        for field in fields_of_kind(stage, "picture"):
            if field.hint.get("colormap") == "gray":
                for camera, reference in field.arrays.items():
                    found.setdefault(camera, picture_address(reference.hash, max_px=_PICTURE_PX))
    return found
