"""The states that scans, stages and jobs can be in, and the verdicts an operator can give."""

import enum


class Review(enum.StrEnum):
    """When a finished stage waits for the operator."""

    ALWAYS = "always"
    ON_WARNING = "on_warning"
    ON_FAILURE = "on_failure"


class Level(enum.StrEnum):
    """What a check says of a result."""

    OK = "ok"
    WARNING = "warning"
    FAILURE = "failure"


class StageStatus(enum.StrEnum):
    """Where a stage of a scan stands. Derived from keys, runs and decisions, never stored.

    ```mermaid
    stateDiagram-v2
        [*] --> pending
        unavailable --> pending : an input is supplied
        pending --> running
        running --> done : checks pass the review rule
        running --> awaiting_review
        running --> failed
        awaiting_review --> accepted
        awaiting_review --> rejected
        done --> accepted
        accepted --> pending : an edit upstream or here makes a new key
        failed --> pending : an edit, or run again
    ```
    """

    UNAVAILABLE = "unavailable"
    """A required input is supplied by nothing; the message names it."""
    PENDING = "pending"
    """No finished run with today's key: it will run when asked to."""
    RUNNING = "running"
    DONE = "done"
    """Finished, and its review rule doesn't ask for a look."""
    AWAITING_REVIEW = "awaiting_review"
    ACCEPTED = "accepted"
    REJECTED = "rejected"
    """The operator refused the result: edit a setting or redo."""
    FAILED = "failed"
    GIVEN = "given"
    """The result was handed over with the scan (imported frames): nothing to run."""


class JobStatus(enum.StrEnum):
    """Where a job stands.

    ```mermaid
    stateDiagram-v2
        [*] --> queued
        queued --> running
        running --> awaiting_review : a gate
        running --> finished
        running --> failed
        running --> cancelled
        running --> interrupted : the process died; found at the next start
    ```
    """

    QUEUED = "queued"
    RUNNING = "running"
    AWAITING_REVIEW = "awaiting_review"
    FINISHED = "finished"
    FAILED = "failed"
    CANCELLED = "cancelled"
    INTERRUPTED = "interrupted"

    @property
    def ended(self) -> bool:
        """True when the job will not go on by itself."""
        return self not in (JobStatus.QUEUED, JobStatus.RUNNING)


class Verdict(enum.StrEnum):
    """What the operator decided about one result."""

    ACCEPT = "accept"
    REJECT = "reject"
