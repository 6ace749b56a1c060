"""What running one stage amounts to, wherever it runs: in this process or in a worker."""

import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import Any

from backend.domain.errors import StageFailedError, UnglareError
from backend.domain.params import Params
from backend.domain.shots import Progress
from backend.domain.stage import Stage
from backend.methods import Registry
from backend.numerics.errors import NumericsError
from backend.storage.artifacts import ArtifactStore
from backend.storage.codec import content_hash, decode, encode

Document = dict[str, Any]


@dataclass(frozen=True)
class StageTask:
    """One stage with settings and inputs, as data: hashes instead of arrays, so it is small to send."""

    method: str
    stage: str
    settings: Mapping[str, Any]
    inputs: Mapping[str, Document | None]
    """Encoded result for each input; None for an optional one that nothing supplies."""


@dataclass(frozen=True)
class Outcome:
    """What a stage made."""

    document: Document
    hash: str
    checks: tuple[dict[str, Any], ...]
    seconds: float | None = None
    """How long it took; None where whoever asked measures it."""
    device: Mapping[str, Any] = field(default_factory=dict)
    """What the rig's devices told of themselves, if the stage captured."""


class StageDefectError(Exception):
    """A stage failed in a way that nobody expected: for the log, with its traceback.

    Not an `UnglareError`: it isn't the operator's to mend.
    """

    def __init__(self, sentence: str, trace: str) -> None:
        super().__init__(sentence, trace)
        self.sentence = sentence
        self.trace = trace


def perform(
    task: StageTask, registry: Registry, store: ArtifactStore, progress: Progress
) -> Outcome:
    """Run a pure stage.

    Raises
    ------
    UnglareError
        Whatever the stage says, as one sentence.
    StageDefectError
        Anything else.
    """
    stage = registry.get(task.method).stage(task.stage)
    params = stage.params.model_validate(task.settings)
    with stage_errors(stage):
        inputs = decode_inputs(stage, task.inputs, store)
        result = stage.run(inputs, params, progress=progress, load=store.get)
        return conclude(stage, result, params, store)


def decode_inputs(
    stage: Stage, documents: Mapping[str, Document | None], store: ArtifactStore
) -> dict[str, Any]:
    """Make the inputs' results of their documents; arrays are mapped, frames load when looked at."""
    results: dict[str, Any] = {}
    for i in stage.inputs:
        document = documents[i.name]
        results[i.name] = None if document is None else decode(document, i.type, store)
    return results


def conclude(stage: Stage, result: Any, params: Params, store: ArtifactStore) -> Outcome:
    """Check a result, put its arrays into the store and write it as a document."""
    checks = tuple(asdict(check) for check in stage.check(result, params))
    document = encode(result, store)
    return Outcome(document, content_hash(document), checks)


@contextmanager
def stage_errors(stage: Stage) -> Iterator[None]:
    """Turn what a stage may raise into one sentence, and everything else into a defect."""
    try:
        yield
    except UnglareError:
        raise
    except NumericsError as error:
        raise StageFailedError(str(error)) from error
    except MemoryError as error:
        raise StageFailedError(
            f"{stage.title} needs more memory than there is: close other programs or use smaller pictures."
        ) from error
    except Exception as error:
        sentence = f"Defect in stage {stage.name}: {type(error).__name__}: {error}; see the log."
        raise StageDefectError(sentence, traceback.format_exc()) from error
