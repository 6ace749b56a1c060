"""Libraries that come with an extra of this package and may be missing."""

import importlib
import re
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
            f"{library} isn't installed or can't be loaded ({error}); run: {_cure(error, extra)}",
        ) from error


def _cure(error: ImportError, extra: str) -> str:
    """Say what to install: some wheels are linked against Python's own shared library, which Debian ships apart."""
    missing = re.search(r"libpython[\d.]+\d(?=\.so)", str(error))
    return f"apt-get install {missing[0]}" if missing else f"pip install 'unglare[{extra}]'"
