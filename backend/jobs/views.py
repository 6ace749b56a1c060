"""A job as the clients see it: its row, and how far it is at this moment."""

from backend.contract.scans import JobView
from backend.jobs.control import Live
from backend.storage.rows import JobRow


def job_view(row: JobRow, live: Live | None) -> JobView:
    """Describe a job; `live` is None for one that isn't running in this process."""
    live = None if row.status.ended else live
    return JobView(
        id=row.id,
        status=row.status,
        stage=live.stage if live else row.stage,
        progress=live.progress if live else row.progress,
        text=live.text if live else row.text,
        remaining_s=live.remaining_s if live else None,
        error=row.error,
        who=row.who,
    )
