"""Gray code, columns and rows: from imported frames for now; capturing stages with the intensity mask follow."""

from backend.domain.method import Method
from backend.domain.rig import RigCalibration, RigFacts
from backend.stages.code_cloud import code_cloud
from backend.stages.code_frames import CodeFrames, import_code_frames
from backend.stages.edges import edges

METHOD = Method(
    name="adaptive-code",
    title="Adaptive binary code",
    doc="Black, dark and shiny parts at once: Gray code in columns and rows, decoded against its inverse.",
    stages=(edges, code_cloud),
    given=(CodeFrames, RigFacts, RigCalibration),
    importers={CodeFrames.__name__: import_code_frames},
)
