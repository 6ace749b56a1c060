"""The left panel: what the cameras see at this stage, one picture per camera."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import viser

from app import markup
from app.client import picture_address
from app.desk import Desk
from app.look import Look, fields_of_kind
from app.numbers import percent
from app.views import frames as frame_view
from app.views import mask as mask_view
from app.views import picture as picture_view
from app.views.picture import Figure
from backend.contract.scans import FieldView, StageState

_KINDS = ("picture", "mask", "frames")
_MAX_PX = 800
"""Longest side of a picture in the panel: sharp on the wide layout as well."""
_EMPTY = np.full((3, 4, 3), 24, np.uint8)


@dataclass(frozen=True)
class Choice:
    """One thing that can be shown: a field of a stage."""

    label: str
    stage: StageState
    field: FieldView


class PicturesPanel:
    """Pictures and their colour bar or legend, in the container that is open when it is made."""

    def __init__(self, gui: viser.GuiApi, desk: Desk) -> None:
        self._gui, self._desk = gui, desk
        self._look: Look | None = None
        self._wanted: dict[str, str] = {}
        """By stage: the label that was chosen there last."""
        self._menu = _Menu(gui, "Show", self._choose)
        self._exposure = _Menu(gui, "Exposure", self._redraw)
        self._pattern = _Menu(gui, "Pattern", self._redraw)
        self._figures = gui.add_html("")
        self._live_head = gui.add_html("", visible=False)
        self._live_place = gui.add_folder(None, visible=False)
        self._live: dict[str, viser.GuiImageHandle] = {}
        self._drawn: tuple[Any, ...] = ()

    def draw(self, look: Look) -> None:
        """Show this state."""
        self._look = look
        if is_live(look):
            self._menu.hide()
            self._exposure.hide()
            self._pattern.hide()
            self._figures.visible = False
            self._live_head.content = markup.div("ug-heading", "Live")
            self._live_head.visible = self._live_place.visible = True
            self._drawn = ()
            return
        self._live_head.visible = self._live_place.visible = False
        self._figures.visible = True
        self._draw_choice(look)

    def show_live(self, camera: str, jpeg: bytes, *, order: int = 0) -> None:
        """Show the newest picture of a camera while a stage captures."""
        picture = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
        if picture is None:
            return
        rgb = cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)
        if camera not in self._live:
            with self._live_place:
                self._live[camera] = self._gui.add_image(
                    rgb, label=camera, format="jpeg", jpeg_quality=80, order=order
                )
        else:
            self._live[camera].image = rgb

    def figures(self) -> tuple[Choice, list[Figure]] | None:
        """Return what is on the screen and its pictures; None if there is nothing."""
        choice = self._chosen(choices(self._look)) if self._look else None
        return (choice, self._figures_of(choice, _MAX_PX * 2)) if choice else None

    def _choose(self, label: str) -> None:
        if self._look is not None:
            self._wanted[self._look.stage.name] = label
            self._redraw(label)

    def _redraw(self, _: str) -> None:
        look = self._look
        if look is not None:
            self._desk.load(lambda: self._draw_choice(look), key="pictures")

    def _draw_choice(self, look: Look) -> None:
        offered = choices(look)
        choice = self._chosen(offered)
        if choice is None:
            self._menu.hide()
            self._exposure.hide()
            self._pattern.hide()
            self._figures.content = markup.div(
                "ug-empty", "No picture yet. It appears as soon as a stage has made one."
            )
            self._drawn = ()
            return
        self._menu.show([c.label for c in offered], choice.label)
        self._draw_frame_menus(choice)
        drawn = (
            choice.label,
            choice.stage.stage_run,
            self._exposure.value,
            self._pattern.value,
            look.may_operate,
        )
        if drawn != self._drawn:
            self._drawn = drawn
            self._figures.content = self._html(choice)

    def _chosen(self, offered: list[Choice]) -> Choice | None:
        wanted = self._wanted.get(self._look.stage.name) if self._look else None
        return next((c for c in offered if c.label == wanted), offered[0] if offered else None)

    def _draw_frame_menus(self, choice: Choice) -> None:
        if choice.field.hint.get("kind") != "frames":
            self._exposure.hide()
            self._pattern.hide()
            return
        menu = frame_view.FrameMenu(choice.field.frames)
        exposures = menu.exposures()
        present = self._exposure.value
        self._exposure.show(
            exposures, present if present in exposures else exposures[len(exposures) // 2]
        )
        self._pattern.show(menu.patterns(), self._pattern.value)

    def _html(self, choice: Choice) -> str:
        figures = "".join(self._figure_html(f) for f in self._figures_of(choice, _MAX_PX))
        return markup.div("ug-figures", figures) + self._explanation(choice)

    def _figure_html(self, figure: Figure) -> str:
        links = ""
        if figure.full:
            links = markup.tag(
                "a",
                "ug-link",
                "⤢",
                href=figure.full,
                target="_blank",
                title="Full size in a new tab",
            )
        if not self._desk.who.may_operate:
            return picture_view.figure_html(figure, links)
        camera = figure.camera
        ask = self._desk.clicks.label(
            f"inspect {camera}",
            lambda: self._desk.inspect(camera),
            "inspect",
            "ug-link",
            "Enlarge, and ask single pixels",
        )
        return picture_view.figure_html(
            figure, markup.span("", f"{ask} {links}"),
            wrap=lambda image: self._desk.clicks.label(f"inspect picture {camera}", lambda: self._desk.inspect(camera), image, "ug-zoom", "Enlarge, and ask single pixels"),
        )  # fmt: skip

    def _figures_of(self, choice: Choice, max_px: int) -> list[Figure]:
        order = self._look.cameras() if self._look else []
        figures = self._unordered_figures(choice, max_px)
        return sorted(figures, key=lambda f: order.index(f.camera) if f.camera in order else -1)

    def _unordered_figures(self, choice: Choice, max_px: int) -> list[Figure]:
        field, kind = choice.field, choice.field.hint.get("kind")
        if kind == "frames":
            picked = frame_view.FrameMenu(field.frames).pick(
                self._exposure.value, self._pattern.value
            )
            return [frame_view.frame_figure(f, max_px=max_px) for f in picked]
        if kind == "mask":
            return [self._mask_figure(choice, camera, max_px) for camera in field.arrays]
        hint, ends = field.hint, self._ends(field)
        return [
            picture_view.map_figure(c, r.hash, r.shape, colormap=str(hint.get("colormap")), ends=ends, max_px=max_px)
            for c, r in field.arrays.items()
        ]  # fmt: skip

    def _ends(self, field: FieldView) -> picture_view.Range:
        low, high = field.hint.get("low"), field.hint.get("high")
        both = low is not None and high is not None
        maps = [] if both else [self._desk.api.array(r.hash) for r in field.arrays.values()]
        return picture_view.range_of(maps, low, high)

    def _mask_figure(self, choice: Choice, camera: str, max_px: int) -> Figure:
        reference = choice.field.arrays[camera]
        labels = mask_view.Labels.of(choice.field.hint)
        values = mask_view.shrunk(labels, self._desk.api.array(reference.hash), max_px)
        drawn = mask_view.draw(labels, values, self._ground(choice, camera, reference.shape))
        return Figure(
            camera,
            mask_view.as_data_url(drawn),
            None,
            reference.shape[1],
            reference.shape[0],
            reference.hash,
        )

    def _ground(self, choice: Choice, camera: str, shape: tuple[int, ...]) -> Any:
        """Return the gray picture that lies under a mask: the nearest one of the same camera and size."""
        assert self._look is not None, "drawn only with a look"
        for stage in self._look.upto_stage():
            for field in fields_of_kind(stage, "picture"):
                reference = field.arrays.get(camera)
                if (
                    reference is not None
                    and reference.shape == shape
                    and field.hint.get("colormap") == "gray"
                ):
                    address = picture_address(reference.hash, max_px=_MAX_PX)
                    return cv2.imdecode(
                        np.frombuffer(self._desk.api.picture(address), np.uint8),
                        cv2.IMREAD_GRAYSCALE,
                    )
        return None

    def _explanation(self, choice: Choice) -> str:
        hint, kind = choice.field.hint, choice.field.hint.get("kind")
        if kind == "picture":
            return picture_view.colour_bar(
                str(hint.get("colormap")), self._ends(choice.field), str(hint.get("unit") or "")
            )
        if kind == "mask":
            labels = mask_view.Labels.of(hint)
            maps = [self._desk.api.array(r.hash) for r in choice.field.arrays.values()]
            return markup.legend(
                (labels.colour(label), labels.text(label), percent(mask_view.share(labels, label, *maps)))
                for label in labels.present(*maps)
            )  # fmt: skip
        return ""


def is_live(look: Look) -> bool:
    """Tell whether live pictures are wanted: the stage on the screen is taking some."""
    return (
        look.running
        and look.stage.status == "running"
        and bool(look.description and look.description.captures)
    )


def choices(look: Look) -> list[Choice]:
    """Return what can be shown: the stage's own pictures first, then those of the stages before it."""
    found = []
    for i, stage in enumerate(look.upto_stage()):
        for field in fields_of_kind(stage, *_KINDS):
            if field.arrays or field.frames:
                title = str(field.hint.get("title") or field.name)
                found.append(Choice(title if i == 0 else f"{stage.title} · {title}", stage, field))
    return list({c.label: c for c in reversed(found)}.values())[::-1]


class _Menu:
    """A dropdown that exists only while it has something to choose from."""

    def __init__(self, gui: viser.GuiApi, label: str, on_choice: Any) -> None:
        self._handle: Any = gui.add_dropdown(label, ["–"], visible=False)
        self._options: tuple[str, ...] = ("–",)

        @self._handle.on_update
        async def _(event: viser.GuiEvent[Any]) -> None:
            if event.client is not None and self._handle.value in self._options:
                on_choice(self._handle.value)

    @property
    def value(self) -> str:
        return str(self._handle.value)

    def show(self, options: list[str], value: str) -> None:
        if tuple(options) != self._options:
            self._options = tuple(options)
            self._handle.options = self._options
        self._handle.value = value if value in options else options[0]
        self._handle.visible = len(options) > 1

    def hide(self) -> None:
        self._handle.visible = False
