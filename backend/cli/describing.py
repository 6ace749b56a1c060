"""`unglare methods`: what can be measured with, and every setting of it."""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, Any

import typer

from backend.cli.options import AsJson
from backend.cli.output import answering, console, table

if TYPE_CHECKING:
    from backend.domain.stage import Stage


def register(application: typer.Typer) -> None:
    """Add the commands of this module."""
    application.command()(methods)


def methods(
    name: Annotated[
        str | None, typer.Argument(help="Show only this method, with its settings.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List the measuring methods with their stages and settings."""
    from backend.methods import registry

    with answering(as_json) as answer:
        known = registry()
        chosen = [known.get(name)] if name else [known.methods[n] for n in sorted(known.methods)]
        answer.update({"methods": [m.describe() for m in chosen], "broken": dict(known.broken)})
        if as_json:
            return
        out = console()
        for method in chosen:
            out.print(f"[bold]{method.name}[/bold]: {method.title}. {method.doc}")
            for preset, values in method.presets.items():
                settings = ", ".join(f"{path}={value}" for path, value in values.items())
                out.print(f"  --preset {preset}: {settings}")
            for stage in method.stages:
                out.print(f"\n  [bold]{stage.name}[/bold]: {stage.doc}")
                if name:
                    out.print(_settings_table(stage))
                else:
                    out.print(f"  settings: {', '.join(stage.params.model_fields) or 'none'}")
            out.print("")
        for plug_in, reason in known.broken.items():
            out.print(f"{plug_in} can't be used: {reason}")


def _settings_table(stage: "Stage") -> Any:
    rows = table("setting", "default", "allowed", "meaning")
    for name, default, allowed, text in setting_rows(stage):
        rows.add_row(f"{stage.name}.{name}", default, allowed, text)
    return rows


def setting_rows(stage: "Stage") -> Iterator[tuple[str, str, str, str]]:
    """Return name, default, what is allowed and the meaning of every setting of a stage."""
    from backend.jobs.stage_settings import allowed_values

    schema: Mapping[str, Any] = stage.params.model_json_schema().get("properties", {})
    defaults = stage.params().model_dump(mode="json")
    for name, described in schema.items():
        default = "automatic" if defaults[name] is None else str(defaults[name])
        text = " ".join(described.get("description", described.get("title", "")).split())
        yield name, default, allowed_values(stage.params, name), text
