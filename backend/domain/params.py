"""Settings of a stage: frozen, checked, described once for API, UI and command line."""

from typing import Any

from pydantic import BaseModel, ConfigDict, Field


class Params(BaseModel):
    """Base of every stage's settings. A docstring under a field is its help text."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        allow_inf_nan=False,
        use_attribute_docstrings=True,
        validate_default=True,
    )


def setting(
    default: Any,
    *,
    title: str,
    unit: str = "",
    auto: str | None = None,
    cosmetic: bool = False,
    advanced: bool = False,
    **limits: Any,
) -> Any:
    """Describe one setting.

    Parameters
    ----------
    default
        Value when nobody edits it. None means automatic: the stage chooses.
    title
        Label of the control.
    unit
        Unit as shown behind the control, "" for none.
    auto
        Name of the result field that holds the value chosen when this is None.
    cosmetic
        True: the value can't change the result and stays out of the key.
    advanced
        True: shown folded away.
    limits
        pydantic's ge, gt, le, lt, min_length, max_length, multiple_of ...
    """
    extra: dict[str, Any] = {"unit": unit, "auto": auto, "cosmetic": cosmetic, "advanced": advanced}
    return Field(default, title=title, json_schema_extra=extra, **limits)


def without_cosmetics(params: Params) -> dict[str, Any]:
    """Return the settings that can change the result, as JSON values."""
    document = params.model_dump(mode="json")
    for name, field in type(params).model_fields.items():
        extra = field.json_schema_extra
        if isinstance(extra, dict) and extra.get("cosmetic"):
            del document[name]
    return document
