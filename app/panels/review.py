"""What a stage's result says: findings, charts, tables and facts. One view per kind of hint."""

from typing import Any

import viser

from app import markup
from app.client import ApiClient
from app.desk import Desk
from app.look import Look, fields_of_kind
from app.numbers import duration, percent, quantity
from app.palette import LEVELS
from app.views.curve import Axis, add_curves
from app.views.histogram import Counts, HistogramView
from app.views.table import table_html
from app.views.value import fact_rows
from backend.contract.scans import CheckView, FieldView, StageState

_CHARTS = ("histogram", "curve", "table")


class ReviewPanel:
    """Findings and charts of the stage on the screen, in the container that is open when it is made."""

    def __init__(self, gui: viser.GuiApi, desk: Desk) -> None:
        self._gui, self._desk = gui, desk
        self._findings = gui.add_html("")
        self._place = gui.add_folder(None)
        self._facts = gui.add_html("")
        self._charts: viser.GuiFolderHandle | None = None
        self._drawn: tuple[Any, ...] = ()
        self._histograms: dict[str, list[HistogramView]] = {}
        """By the setting that their borders edit."""

    def draw(self, look: Look) -> None:
        """Show this state; charts are made anew only for another result."""
        stage = look.stage
        self._findings.content = findings_html(stage)
        self._facts.content = facts_html(stage)
        signature = (look.scan.id, stage.name, stage.stage_run, look.may_operate)
        if signature != self._drawn:
            self._drawn = signature
            self._make_charts(look)
        self.show_draft(look)

    def show_draft(self, look: Look) -> None:
        """Move borders to where the setting, or its draft, has them."""
        for name, views in self._histograms.items():
            view = look.stage.settings.get(name)
            present = view and (view.value if view.value is not None else view.chosen)
            borders = look.draft.get(name) or present
            for histogram in views:
                if borders:
                    histogram.show(borders)

    def _make_charts(self, look: Look) -> None:
        old, self._histograms = self._charts, {}
        with self._place:
            self._charts = self._gui.add_folder(None)
        with self._charts:
            add = {
                "histogram": self._add_histogram,
                "curve": self._add_curve,
                "table": self._add_table,
            }
            for field in _charted(look.stage):
                add[str(field.hint["kind"])](look, field)
        if old is not None:
            old.remove()

    def _add_histogram(self, look: Look, field: FieldView) -> None:
        api, hint = self._desk.api, field.hint
        setting = hint.get("edits")
        can_drag = look.may_operate and setting in look.stage.settings
        for camera, reference in field.arrays.items():
            self._heading(field, camera)
            shown = Counts(
                api.array(reference.hash),
                fit=_sibling(api, look.stage, hint.get("fit"), camera),
                borders=_borders(api, look.stage, hint, camera),
                peaks=_numbers(api, look.stage, hint.get("peaks"), camera),
            )
            on_drag = self._drag(str(setting)) if can_drag else None
            view = HistogramView(
                self._gui, shown, x_title=str(hint.get("x_title") or "gray"), on_drag=on_drag
            )
            if setting:
                self._histograms.setdefault(str(setting), []).append(view)

    def _drag(self, setting: str) -> Any:
        return lambda borders: self._desk.set_draft(setting, list(borders))

    def _add_curve(self, look: Look, field: FieldView) -> None:
        hint = field.hint
        for camera, reference in field.arrays.items():
            self._heading(field, camera)
            add_curves(
                self._gui, self._desk.api.array(reference.hash),
                x=_sibling(self._desk.api, look.stage, hint.get("x"), camera),
                x_axis=Axis(str(hint.get("x_title") or "")), y_axis=Axis("", str(hint.get("unit") or "")),
                names=tuple(hint.get("names") or ()), log_y=bool(hint.get("log_y")),
            )  # fmt: skip

    def _add_table(self, look: Look, field: FieldView) -> None:
        drawn = table_html(field.value)
        if drawn:
            edits = field.hint.get("edits")
            note = "change them in the settings" if edits and look.may_operate else ""
            self._gui.add_html(markup.section(str(field.hint.get("title") or ""), drawn, note=note))

    def _heading(self, field: FieldView, camera: str) -> None:
        title = str(field.hint.get("title") or field.name)
        self._gui.add_html(
            markup.div("ug-heading", markup.esc(f"{title}, {camera}" if camera else title))
        )


def _charted(stage: StageState) -> list[FieldView]:
    """Return the fields to draw: curves that only serve as somebody's axis or fit are left out."""
    serving = {
        f.hint.get(role) for f in stage.fields for role in ("x", "fit", "valleys", "peaks") if f.hint.get(role)
    }  # fmt: skip
    return [f for f in fields_of_kind(stage, *_CHARTS) if f.name not in serving]


def _sibling(api: ApiClient, stage: StageState, name: Any, camera: str) -> Any:
    """Return another field's array: of the same camera, or the one for all cameras."""
    field = next((f for f in stage.fields if f.name == name), None)
    reference = field and (field.arrays.get(camera) or field.arrays.get(""))
    return api.array(reference.hash) if reference else None


def _numbers(api: ApiClient, stage: StageState, name: Any, camera: str) -> tuple[float, ...] | None:
    array = _sibling(api, stage, name, camera)
    if array is not None:
        return tuple(float(v) for v in array.ravel())
    field = next((f for f in stage.fields if f.name == name), None)
    return tuple(float(v) for v in field.value) if field and isinstance(field.value, list) else None


def _borders(
    api: ApiClient, stage: StageState, hint: dict[str, Any], camera: str
) -> tuple[float, ...]:
    setting = stage.settings.get(str(hint.get("edits")))
    if setting is not None:
        present = setting.value if setting.value is not None else setting.chosen
        if isinstance(present, (list, tuple)):
            return tuple(float(v) for v in present)
    return _numbers(api, stage, hint.get("valleys"), camera) or ()


def findings_html(stage: StageState) -> str:
    """Return the checks, the gravest first."""
    if not stage.checks:
        return ""
    order = {"failure": 0, "warning": 1, "ok": 2}
    lines = [_finding(check) for check in sorted(stage.checks, key=lambda c: order.get(c.level, 3))]
    return markup.div("ug-findings", "".join(lines))


def _finding(check: CheckView) -> str:
    colour, symbol = LEVELS.get(check.level, LEVELS["ok"])
    limit = "" if check.limit is None else f"limit {_in_words(check, check.limit)}"
    title = check.name if check.value is None else f"{check.name}: {_in_words(check, check.value)}"
    return markup.div(
        f"ug-finding ug-is-{check.level}",
        f'<i style="--c:{colour}">{symbol}</i>' + markup.span("ug-sentence", markup.esc(check.sentence)) + markup.span("ug-note", markup.esc(limit)),
        title=title,
    )  # fmt: skip


def _in_words(check: CheckView, value: float) -> str:
    """Write a check's value or limit as its sentence does: a share without unit in percent."""
    if not check.unit and "%" in check.sentence and abs(value) <= 1.0:
        return percent(value)
    return quantity(value, check.unit)


def facts_html(stage: StageState) -> str:
    """Return the stage's numbers and texts."""
    rows = fact_rows(fields_of_kind(stage, "value"))
    if stage.duration_s is not None and stage.fields:
        rows.append(("Time taken", duration(stage.duration_s)))
    if stage.take > 1:
        rows.append(("Take", str(stage.take)))
    return markup.section("Result", markup.facts(rows)) if rows else ""
