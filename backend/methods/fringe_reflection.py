"""Fringe reflection: mirrors measured by what they show of a screen, through an optimised camera response.

Source: "Precise phase measurement for fringe reflection technique through optimized camera response",
Sensors 23(23), 9299 (2023), doi:10.3390/s23239299.
"""

from backend.domain.method import Method
from backend.domain.rig import RigCalibration, RigFacts
from backend.stages.camera_response import camera_response
from backend.stages.interval import interval
from backend.stages.linearise import linearise
from backend.stages.mirror_cloud import mirror_cloud
from backend.stages.mirror_files import (
    defects_png,
    modulation_png,
    result_npz,
    summary_json,
    surface_csv,
    surface_h5,
)
from backend.stages.ramp import Ramp, ramp
from backend.stages.reflect_capture import reflect_capture, reflect_frames
from backend.stages.screen_phase import screen_phase
from backend.stages.slopes import slopes
from backend.stages.stack import import_stack, stack
from backend.stages.surface import surface

METHOD = Method(
    name="fringe-reflection",
    title="Fringe reflection",
    doc="Measures mirrors: fringes on a screen, seen through the part, tell the slope of every point.",
    stages=(
        stack,
        camera_response,
        ramp,
        interval,
        linearise,
        reflect_capture,
        screen_phase,
        slopes,
        surface,
        mirror_cloud,
    ),
    given=(RigFacts, RigCalibration, Ramp),
    files={
        "result.npz": result_npz,
        "summary.json": summary_json,
        "modulation.png": modulation_png,
        "defects.png": defects_png,
        "surface.csv": surface_csv,
        "surface.h5": surface_h5,
    },
    importers={"reflect_capture": reflect_frames, "stack": import_stack},
)
