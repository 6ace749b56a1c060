"""Multi-exposure phase shifting: high dynamic range by exposures that fit the scene.

Source: "High dynamic range saturation intelligence avoidance for three-dimensional shape measurement" (HDRSIA).
"""

from backend.domain.method import Method
from backend.stages.exposures import exposures
from backend.stages.fringe_capture import fringe_capture, import_fringes
from backend.stages.fringe_phase import fringe_phase
from backend.stages.fusion import fusion
from backend.stages.pre_exposure import pre_exposure
from backend.stages.stereo_cloud import stereo_cloud
from backend.stages.zones import zones

METHOD = Method(
    name="hdr-fringe",
    title="Multi-exposure phase shifting",
    doc="Measures bright and black parts at once: exposures that fit the scene, fused pixel by pixel.",
    stages=(pre_exposure, zones, exposures, fringe_capture, fusion, fringe_phase, stereo_cloud),
    presets={
        "fast": {"exposures.budget": "fast"},
        "thorough": {"exposures.budget": "thorough", "exposures.most": 7},
        "paper": {
            "exposures.strategy": "hdrsia",
            "fusion.strategy": "masks",
            "fringe_phase.unwrapping": "cascade",
        },
    },
    importers={"fringe_capture": import_fringes},
)
