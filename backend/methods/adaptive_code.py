"""Gray code and shifted stripes under an intensity mask that the rig finds by itself.

Source: C. Zhang et al., "A Robust Surface Coding Method for Optically Challenging Objects Using Structured Light",
IEEE T-ASE 11(3), 775 (2014), doi:10.1109/TASE.2013.2293576.
"""

from backend.domain.method import Method
from backend.domain.rig import RigCalibration, RigFacts
from backend.stages.base_exposure import base_exposure
from backend.stages.code_capture import code_capture
from backend.stages.code_cloud import code_cloud
from backend.stages.code_frames import import_code_frames
from backend.stages.edges import edges
from backend.stages.flat_mask import flat_mask
from backend.stages.joined_codes import joined_codes
from backend.stages.pixel_response import pixel_response
from backend.stages.refine import refine
from backend.stages.second_look import second_look
from backend.stages.table_homography import TableHomography

METHOD = Method(
    name="adaptive-code",
    title="Adaptive binary code",
    doc="Black, dark and shiny parts at once: bright places are dimmed one by one, then coded in black and white.",
    stages=(
        base_exposure,
        pixel_response,
        flat_mask,
        refine.named("refine_1"),
        refine.named("refine_2"),
        refine.named("refine_3"),
        code_capture,
        edges,
        second_look,
        joined_codes,
        code_cloud,
    ),
    given=(RigFacts, RigCalibration, TableHomography),
    importers={"code_capture": import_code_frames},
    presets={
        "single pass": {"refine_1.run": "yes", "refine_2.run": "no", "refine_3.run": "no"},
        "paper": {
            "pixel_response.black_and_white": False,
            "flat_mask.dilation_px": 5.0,
            "flat_mask.target": 0.99,
            "flat_mask.smoothing_px": 0.0,
            "second_look.run": "no",
            **{
                f"refine_{number}.{name}": value
                for number in (1, 2, 3)
                for name, value in {
                    "target": 0.99,
                    "smoothing_px": 0.0,
                    "trims": 0,
                    "shorter": 0,
                    "dilation_px": 2.0,
                }.items()
            },
        },
    },
)
