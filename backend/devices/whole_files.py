"""Small files that are there as a whole or not at all."""

from pathlib import Path

from backend.devices.errors import RigConfigError


def write_whole(path: Path, text: str) -> Path:
    """Write a text beside a rig's file; what stood there before stays if it can't be written.

    Raises
    ------
    RigConfigError
        If the folder has no room, or may not be written to.
    """
    partial = path.with_name(f".{path.name}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_text(text, "utf-8")
        return partial.replace(path)
    except OSError as error:
        raise RigConfigError(
            f"{path} can't be written ({error.strerror}); check the data folder's rights and space"
        ) from error
