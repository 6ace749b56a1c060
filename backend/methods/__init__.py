"""One file per measuring method, and the registry that finds them (those of plug-ins too)."""

import importlib
import pkgutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.metadata import entry_points

from backend.domain.errors import NotFoundError
from backend.domain.method import Method

ENTRY_POINT_GROUP = "unglare.methods"


@dataclass(frozen=True)
class Registry:
    """The methods that can be used, and why others can't."""

    methods: Mapping[str, Method]
    broken: Mapping[str, str] = field(default_factory=dict)
    """Plug-ins that failed to load: name -> one sentence."""

    def get(self, name: str) -> Method:
        """Return a method by name, or say which there are."""
        if name in self.methods:
            return self.methods[name]
        reason = f" ({self.broken[name]})" if name in self.broken else ""
        known = ", ".join(sorted(self.methods))
        raise NotFoundError(f"There is no method {name!r}{reason}; there are: {known}.")


@lru_cache(maxsize=1)
def registry() -> Registry:
    """Load every method of this package, then those of plug-ins; a failing plug-in is kept out and named."""
    methods = {method.name: method for method in _own()}
    broken: dict[str, str] = {}
    for entry in entry_points(group=ENTRY_POINT_GROUP):
        try:
            method = entry.load()
        except (Exception, SystemExit) as error:  # noqa: BLE001  foreign code: whatever it raises, the application starts
            broken[entry.name] = f"plug-in {entry.value} failed to load: {error}"
            continue
        if isinstance(method, Method) and method.name not in methods:
            methods[method.name] = method
        else:
            broken[entry.name] = f"plug-in {entry.value} is no Method with a name of its own"
    return Registry(methods, broken)


def _own() -> list[Method]:
    modules = (
        importlib.import_module(f"{__name__}.{m.name}") for m in pkgutil.iter_modules(__path__)
    )
    return [module.METHOD for module in modules]
