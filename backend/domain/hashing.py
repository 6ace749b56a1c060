"""One way to hash documents, and the key that identifies a stage run."""

import hashlib
import json
from collections.abc import Mapping
from typing import Any


def canonical_json(document: Any) -> str:
    """Write JSON values in the one form that is hashed: sorted keys, no spaces, no NaN."""
    return json.dumps(
        document, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=False
    )


def document_hash(document: Any) -> str:
    """Hash JSON values (sha256, hexadecimal)."""
    return hashlib.sha256(canonical_json(document).encode()).hexdigest()


def stage_key(
    *,
    stage: str,
    version: int,
    settings: Mapping[str, Any],
    inputs: Mapping[str, str | None],
    capture: str | None,
) -> str:
    """Identify a stage run.

    Parameters
    ----------
    stage
        Name of the stage's function (not the name under which a method repeats it).
    version
        The stage's version: a change of its algorithm.
    settings
        Settings without cosmetic fields, as JSON values.
    inputs
        Content hash of each input; None for an optional input that nothing supplies.
    capture
        Capture id `scan/stage/take` if the stage captures, else None.
    """
    return document_hash([stage, version, dict(settings), dict(inputs), capture])
