"""Expected errors: each ends as one sentence that names the thing, the value and the way out.

Everything that is not an `UnglareError` is a defect and keeps its traceback.
"""

from collections.abc import Mapping


class UnglareError(Exception):
    """An expected error; its text is the one sentence that the operator reads."""

    status = 400
    """HTTP status of the answer when the error reaches the API."""

    def __init__(self, sentence: str, *, details: Mapping[str, object] | None = None) -> None:
        super().__init__(sentence)
        self.sentence = sentence
        self.details = dict(details or {})


def sentence_of(error: Exception) -> str:
    """Make a sentence of the text of an error that isn't one yet: capital letter and full stop.

    Examples
    --------
    >>> sentence_of(ValueError("the ramp isn't monotone: measure it again"))
    "The ramp isn't monotone: measure it again."
    """
    text = str(error)
    return f"{text[:1].upper()}{text[1:]}."


class NotFoundError(UnglareError):
    """A scan, stage, artifact, method, rig or file that isn't there. Check the name."""

    status = 404


class InvalidSettingError(UnglareError):
    """A setting's name or value can't be used. The sentence names the allowed range."""

    status = 422


class InvalidCaptureError(UnglareError):
    """An imported folder, file or frame set can't be used. The sentence names the file or frame."""

    status = 422


class InvalidCalibrationError(UnglareError):
    """A calibration is singular, not finite or doesn't fit the rig. Calibrate again."""

    status = 422


class StaleEditError(UnglareError):
    """Somebody else edited since the caller last looked; `details` holds that edit. Look, then edit again."""

    status = 409


class ConflictError(UnglareError):
    """What is asked for doesn't fit the present state (a job is running, nothing to undo)."""

    status = 409


class RigBusyError(ConflictError):
    """Another job owns the rig. Wait for it or cancel it."""


class StageUnavailableError(UnglareError):
    """A stage lacks an input that nothing supplies; the stages before it keep their results."""

    status = 409


class StageFailedError(UnglareError):
    """A stage can't make a result from these inputs and settings; the sentence says which and what to change."""

    status = 422


class RigFailedError(UnglareError):
    """A device failed in the middle of a scan. Captured frames are kept; run again to go on."""

    status = 502


class CancelledError(UnglareError):
    """The operator cancelled the job. Finished stages and captured frames are kept."""

    status = 409


class StorageFullError(UnglareError):
    """There is no room on the disk. Nothing was half-written; free some and run again."""

    status = 507


class CorruptDataError(UnglareError):
    """An artifact or row isn't what was written. Restore it from a backup or run the stage again."""

    status = 500


class RefusedError(UnglareError):
    """The caller may not do that: no valid token, or the role doesn't allow it."""

    status = 403


class StartupError(UnglareError):
    """The application can't start: a port in use, a folder that can't be written, a database that is too new."""

    status = 500
