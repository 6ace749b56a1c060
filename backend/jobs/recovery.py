"""After a start: what a killed process left as running becomes interrupted, and can be run again."""

from backend.domain.states import JobStatus
from backend.storage.database import Database
from backend.storage.repositories import Repositories
from backend.storage.rows import JobRow

SENTENCE = "The application stopped in the middle: finished stages and captured frames count, run again to go on."


def recover(database: Database) -> int:
    """Mark unfinished jobs and runs as interrupted; return how many jobs there were.

    To be called once, when a process starts that owns the database's jobs, before anything runs: a job that
    runs in another process at that moment would be marked, too.
    """
    with database.transaction() as repositories:
        for run in repositories.runs.unfinished():
            repositories.runs.interrupt(run.id)
        jobs = repositories.jobs.unfinished()
        for job in jobs:
            interrupt(repositories, job)
    return len(jobs)


def interrupt(repositories: Repositories, job: JobRow) -> None:
    """Mark one job as interrupted, with its line in the audit trail."""
    repositories.jobs.update(job.id, status=JobStatus.INTERRUPTED, error=SENTENCE)
    repositories.audit.add(job.scan, job.who, "interrupted", job.stage, SENTENCE, {"job": job.id})
