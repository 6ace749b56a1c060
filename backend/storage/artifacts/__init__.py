"""Arrays under the hash of their content: the protocol, and the folder that keeps them here."""

from backend.storage.artifacts.local import LocalArtifactStore
from backend.storage.artifacts.store import (
    Array,
    ArtifactMeta,
    ArtifactStore,
    StoredPixels,
    is_hash,
)

__all__ = [
    "Array",
    "ArtifactMeta",
    "ArtifactStore",
    "LocalArtifactStore",
    "StoredPixels",
    "is_hash",
]
