"""Cloud and mesh in the scene, and the small panel that says what their colours mean."""

import asyncio
import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import viser

from app import markup
from app.client import PointsPreview
from app.desk import Desk
from app.look import Look, fields_of_kind
from app.numbers import number, quantity
from app.palette import stops
from app.space import UNIT, Placement, Space
from app.views import points as points_view
from app.views.points import Ground, Mode
from backend.contract.scans import FieldView, StageState

FIRST_BUDGET, LIVE_BUDGET, REVIEW_BUDGET, FULL_BUDGET = 60_000, 300_000, 1_000_000, 3_000_000
"""Points that come at once, and those that come after them, as many as the operator wants."""
_BUDGETS = {"300 k": LIVE_BUDGET, "1 M": REVIEW_BUDGET, "3 M": FULL_BUDGET}
_PANEL_PX = 252
_STEADY_LEVELS = 2
"""Levels of detail that are drawn while the viewer moves, too."""
_AT_REST_S = 0.6
_PIXELS_NEAR = 6.0


@dataclass(frozen=True)
class Picked:
    """The point that was clicked."""

    point_mm: Any
    facts: list[tuple[str, str]]


class CloudPanel:
    """The cloud of the scan on the screen."""

    def __init__(
        self, client: viser.ClientHandle, space: Space, desk: Desk, *, budget: int
    ) -> None:
        self._space, self._desk, self._client = space, desk, client
        self._budget = budget
        self._drawn: tuple[Any, ...] = ()
        self._cloud: PointsPreview | None = None
        self._modes: dict[str, Mode] = {}
        self._nodes: list[viser.PointCloudHandle] = []
        """One per level of detail: each brings points between those of the ones before."""
        self._mesh: Any = None
        self._ground: Ground | None = None
        self._moved_s = 0.0
        self._is_thin = False
        self._make_panel(client.gui)
        client.camera.on_update(self._moved)

    def extent(self) -> tuple[Any, float]:
        """Return where the middle of the cloud is in the scene, and how far it reaches from there."""
        if self._cloud is None:
            return np.zeros(3), 2.0
        low, high = np.percentile(self._cloud.points_mm, [2, 98], axis=0)
        middle = self._space.placement.to_scene((low + high) / 2)
        return middle, 0.5 * float(np.linalg.norm(high - low)) * UNIT

    @property
    def is_shown(self) -> bool:
        """True if there is a cloud."""
        return bool(self._nodes)

    def draw(self, look: Look) -> None:
        """Show the last cloud of this scan: coarse at once, then finer and finer up to the budget."""
        found = _last(look, "points")
        mesh = _last(look, "mesh")
        drawn = tuple((f[0].stage_run if f else None) for f in (found, mesh))
        if (look.scan.id, *drawn) == self._drawn:
            return
        self._drawn = (look.scan.id, *drawn)
        self._draw_mesh(mesh)
        if found is None:
            self.clear()
            return
        self._start(found)

    def clear(self) -> None:
        """Take the cloud away."""
        for node in self._nodes:
            node.remove()
        self._nodes, self._cloud, self._modes = [], None, {}
        self._panel.visible = False

    def forget(self) -> None:
        """Take everything away, and draw anew next time."""
        self._drawn = ()
        self.clear()
        if self._mesh is not None:
            self._mesh.remove()
            self._mesh = None
        self._panel.visible = False

    def set_panel_visible(self, visible: bool) -> None:
        """Show or hide the small panel without forgetting anything."""
        self._panel.visible = visible and self.is_shown

    def pick(self, origin: Any, direction: Any) -> Picked | None:
        """Return the point that a ray of the scene hits."""
        cloud = self._cloud
        if cloud is None:
            return None
        placement = self._space.placement
        towards = placement.direction_to_rig(np.asarray(direction, dtype=np.float64))
        camera = self._client.camera
        tolerance = _PIXELS_NEAR * 2.0 * np.tan(camera.fov / 2) / max(camera.image_height, 1)
        index = points_view.hit(
            cloud.points_mm, placement.to_rig_mm(np.asarray(origin)), towards, float(tolerance)
        )
        if index is None:
            return None
        point = cloud.points_mm[index]
        facts = [("x, y, z", quantity([float(v) for v in point], "mm", 5))]
        facts += [
            (m.name, quantity(float(m.values[index]), m.unit))
            for m in self._modes.values()
            if m.values is not None
        ]
        return Picked(point, facts)

    # ---- inside

    async def _moved(self, _: Any) -> None:
        """While the viewer moves, draw fewer points: a browser without a graphics card takes long for all."""
        self._moved_s = time.monotonic()
        finest = self._nodes[_STEADY_LEVELS:]
        if self._is_thin or not finest:
            return
        self._is_thin = True
        _show(finest, visible=False)
        while time.monotonic() - self._moved_s < _AT_REST_S:  # noqa: ASYNC110  nothing tells when the viewer rests
            await asyncio.sleep(_AT_REST_S / 3)
        self._is_thin = False
        _show(self._nodes[_STEADY_LEVELS:], visible=True)

    def _make_panel(self, gui: viser.GuiApi) -> None:
        self._panel = gui.add_panel(visible=False)
        with self._panel.add_tab("Cloud", viser.Icon.CUBE):
            self._colour: Any = gui.add_dropdown("Colour", ["Height"])
            self._bar = gui.add_html("")
            self._note = gui.add_html("")
        self._panel.float(x=12, y=-12, width=_PANEL_PX)

        @self._colour.on_update
        async def _(event: viser.GuiEvent[Any]) -> None:
            if event.client is not None:
                self._desk.load(self._recolour, key="recolour")

    def _set_budget(self, budget: int) -> None:
        self._budget = budget
        self._desk.load(self._fetch_again, key="cloud in full")

    def _fetch_again(self) -> None:
        look = self._desk.look
        found = _last(look, "points") if look else None
        if found is not None:
            self._start(found, settle=False)

    def _start(self, found: tuple[StageState, FieldView], *, settle: bool = True) -> None:
        """Show the coarsest level, and ask for the next ones behind whatever else is to be drawn."""
        budget = min(FIRST_BUDGET, self._budget)
        cloud = self._points(found, budget, beyond=0)
        if cloud is None:
            return
        self.clear()
        if not len(cloud.points_mm):
            return
        self._cloud = cloud
        if settle or self._ground is None:
            self._settle(cloud)
        assert self._ground is not None, "set by _settle"
        self._modes = points_view.modes(cloud, self._ground)
        self._colour.options = tuple(self._modes)
        if self._colour.value not in self._modes:
            self._colour.value = next(iter(self._modes))
        self._add_points(cloud)
        self._refine(found, budget)

    def _refine(self, found: tuple[StageState, FieldView], budget: int) -> None:
        """Ask for the next level of detail if there is one."""
        if (
            self._cloud is None
            or budget >= self._budget
            or len(self._cloud.points_mm) >= self._cloud.total
        ):
            return
        finer = next(
            (b for b in (LIVE_BUDGET, REVIEW_BUDGET) if budget < b < self._budget), self._budget
        )
        self._desk.load(lambda: self._fetch_more(found, budget, finer), key="finer cloud")

    def _fetch_more(self, found: tuple[StageState, FieldView], budget: int, finer: int) -> None:
        if self._cloud is None or self._ground is None:
            return
        more = self._points(found, finer, beyond=budget)
        if more is None or self._cloud is None:
            return
        if len(more.points_mm):
            self._cloud = self._cloud.with_more(more)
            modes = points_view.modes(self._cloud, self._ground)
            self._modes = {
                name: replace(mode, low=self._modes[name].low, high=self._modes[name].high)
                for name, mode in modes.items()
            }
            self._add_points(more)
        self._refine(found, finer)

    def _points(
        self, found: tuple[StageState, FieldView], budget: int, *, beyond: int
    ) -> PointsPreview | None:
        """Fetch points; None if the operator has gone on to another scan or result."""
        stage, field = found
        look = self._desk.look
        shown = (look.scan.id if look else None, stage.stage_run)
        if stage.stage_run is None or shown != self._drawn[:2]:
            return None
        return self._desk.api.points(stage.stage_run, field.name, budget=budget, beyond=beyond)

    def _settle(self, cloud: PointsPreview) -> None:
        """Turn the scene so that the table, if there is one, lies level."""
        placement = self._space.placement
        self._ground = points_view.find_ground(cloud.points_mm, placement.R[2])
        middle = np.median(cloud.points_mm, axis=0).astype(np.float64)
        on_floor = middle - (middle @ self._ground.up - self._ground.offset_mm) * self._ground.up
        self._space.place(Placement.of(self._ground.up, placement.R[0], on_floor))
        self._space.view_part(*self.extent())

    def _add_points(self, points: PointsPreview) -> None:
        """Put points between those that are shown, and draw all as large as they are now apart."""
        assert self._cloud is not None, "adds to a cloud"
        start = len(self._cloud.points_mm) - len(points.points_mm)
        mode = self._modes[self._colour.value]
        colours = points_view.colours(points, _part(mode, slice(start, None)))
        size = (
            float(np.clip(points_view.spacing_mm(self._cloud.points_mm) * 1.15, 0.05, 5.0)) * UNIT
        )
        with self._client.atomic():
            for node in self._nodes:
                node.point_size = size
            # Single precision: viser's default of half is 0.5 mm off at 1 m.
            self._nodes.append(
                self._space.scene.add_point_cloud(
                    f"{self._space.root}/cloud {len(self._nodes)}", points.points_mm * np.float32(UNIT), colours,
                    point_size=size, point_shape="square", precision="float32", point_shading="flat",
                )
            )  # fmt: skip
        self._panel.visible = True
        look = self._desk.look
        if look is not None:
            self._explain(look)

    def _recolour(self) -> None:
        look, cloud = self._desk.look, self._cloud
        if cloud is None or self._colour.value not in self._modes or look is None:
            return
        colours = points_view.colours(cloud, self._modes[self._colour.value])
        start = 0
        for node in self._nodes:
            end = start + len(node.points)
            node.colors = colours[start:end]
            start = end
        self._explain(look)

    def _explain(self, look: Look) -> None:
        assert self._cloud is not None, "explains a cloud"
        mode = self._modes[self._colour.value]
        low, high = number(mode.low, 3), number(mode.high, 3)
        bar = markup.gradient_bar(stops(mode.colormap), low, mode.unit, high)
        self._bar.content = markup.div("ug-mode", markup.esc(mode.name)) + bar
        shown, total = len(self._cloud.points_mm), self._cloud.total
        of = (
            f"{number(shown)} of {number(total)} points"
            if shown < total
            else f"{number(total)} points"
        )
        lines = markup.div("", markup.esc(f"{look.scan.name or look.scan.id} · {of}"))
        if look.may_operate:
            lines += self._links("View", self._views()) + self._links(
                "Show", self._budgets(shown, total)
            )
        self._note.content = markup.div("ug-cloud-note", lines)

    def _links(self, head: str, links: list[tuple[str, Callable[[], None]]]) -> str:
        if not links:
            return ""
        label = self._desk.clicks.label
        made = (label(f"{head} {name}", work, name, "ug-link") for name, work in links)
        return markup.div("ug-views", markup.span("", head) + "".join(made))

    def _budgets(self, shown: int, total: int) -> list[tuple[str, Callable[[], None]]]:
        smaller = {name: budget for name, budget in _BUDGETS.items() if budget < total}
        if shown < total or smaller:
            smaller["all" if total <= FULL_BUDGET else "3 M"] = FULL_BUDGET
        return [(name, partial(self._set_budget, budget)) for name, budget in smaller.items()]

    def _views(self) -> list[tuple[str, Callable[[], None]]]:
        return [
            ("rig", lambda: self._desk.act(self._space.view_rig)),
            ("part", lambda: self._desk.act(lambda: self._space.view_part(*self.extent()))),
            ("top", lambda: self._desk.act(lambda: self._space.view_top(*self.extent()))),
        ]

    def _draw_mesh(self, found: tuple[StageState, FieldView] | None) -> None:
        if self._mesh is not None:
            self._mesh.remove()
            self._mesh = None
        if found is None:
            return
        stage, field = found
        faces = next((f for f in stage.fields if f.name == field.hint.get("faces")), None)
        if field.arrays and faces is not None and faces.arrays:
            self._add_mesh(field, faces)

    def _add_mesh(self, vertices: FieldView, faces: FieldView) -> None:
        corners = self._desk.api.array(next(iter(vertices.arrays.values())).hash)
        triangles = self._desk.api.array(next(iter(faces.arrays.values())).hash)
        self._mesh = self._space.scene.add_mesh_simple(
            f"{self._space.root}/mesh", corners.astype(np.float32) * np.float32(UNIT), triangles.astype(np.uint32),
            color=(150, 170, 200), side="double", flat_shading=False,
        )  # fmt: skip


def _show(nodes: list[viser.PointCloudHandle], *, visible: bool) -> None:
    for node in nodes:
        with contextlib.suppress(RuntimeError):  # taken away meanwhile
            node.visible = visible


def _part(mode: Mode, chosen: slice) -> Mode:
    """Return a mode for some of the points."""
    return mode if mode.values is None else replace(mode, values=mode.values[chosen])


def _last(look: Look, kind: str) -> tuple[StageState, FieldView] | None:
    """Return the last field of a kind that the scan has, with its stage."""
    for stage in reversed(look.scan.stages):
        for field in fields_of_kind(stage, kind):
            if stage.stage_run is not None:
                return stage, field
    return None
