"""What may be handed to a scan from outside, and what is."""

from collections.abc import Mapping

from backend.contract.scans import HandedView
from backend.domain.method import Method
from backend.domain.stage import Stage
from backend.domain.type_names import words
from backend.methods import Registry
from backend.storage.rows import GivenRow


def handed_views(method: Method, given: Mapping[str, GivenRow]) -> tuple[HandedView, ...]:
    """Describe what may be handed to a scan, and what is."""
    return tuple(_handed(method, t, name, given.get(name)) for t, name in method.handed.items())


def takers(registry: Registry) -> frozenset[str]:
    """Return the types that some method takes from outside: only such results are worth keeping."""
    return frozenset(t for method in registry.methods.values() for t in method.handed)


def _handed(method: Method, type_name: str, name: str, row: GivenRow | None) -> HandedView:
    origin = (row.origin if row else None) or {}
    said = origin.get("sentence", "Handed over with the scan.") if row else None
    return HandedView(
        type=type_name,
        title=words(type_name),
        name=name,
        stages=_reached(method, type_name, name),
        sentence=said,
        calibration=origin.get("calibration"),
        result_hash=row.hash if row else None,
    )


def _reached(method: Method, type_name: str, name: str) -> tuple[str, ...]:
    if name != type_name:
        return (name,)
    return tuple(s.name for s in method.stages if _reads(s, type_name))


def _reads(stage: Stage, type_name: str) -> bool:
    return any(i.type.__name__ == type_name for i in stage.inputs)
