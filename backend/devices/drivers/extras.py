"""Libraries that come with an extra of this package and may be missing."""

import importlib
import warnings
from typing import Any

from backend.devices.errors import DeviceNotFound


def imported(device: str, module: str, extra: str) -> Any:
    """Import a library when a device needs it.

    Raises
    ------
    DeviceNotFound
        If it isn't installed; the sentence says how to.
    """
    try:
        with warnings.catch_warnings():
            # Libraries wrapped by SWIG warn about their own types; where warnings are errors, they crash in C.
            warnings.simplefilter("ignore", DeprecationWarning)
            return importlib.import_module(module)
    except ImportError as error:
        library = module.partition(".")[0]
        raise DeviceNotFound(
            device,
            f"{library} isn't installed or can't be loaded ({error}); run: pip install 'unglare[{extra}]'",
        ) from error
