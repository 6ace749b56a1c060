"""The empty table as a calibration of the rig: which projector pixel lights each camera pixel where nothing stands."""

from backend.domain.method import Method
from backend.stages.base_exposure import base_exposure
from backend.stages.table_homography import table_homography

METHOD = Method(
    name="table-plane",
    title="Table",
    doc="Calibrates where the bare table lies: scans with an intensity mask start from it.",
    stages=(base_exposure, table_homography),
)
