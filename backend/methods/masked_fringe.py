"""Fringes under the intensity mask that the rig finds by itself, and under bands of epipolar lines where light comes twice."""

from backend.domain.method import Method
from backend.domain.rig import RigCalibration, RigFacts
from backend.stages.band_capture import band_capture
from backend.stages.band_phase import band_phase
from backend.stages.base_exposure import base_exposure
from backend.stages.exposures import exposures
from backend.stages.flat_mask import flat_mask
from backend.stages.fringe_capture import fringe_capture
from backend.stages.fringe_phase import fringe_phase
from backend.stages.fusion import fusion
from backend.stages.pixel_response import pixel_response
from backend.stages.pre_exposure import pre_exposure
from backend.stages.refine import refine
from backend.stages.stereo_cloud import stereo_cloud
from backend.stages.table_homography import TableHomography
from backend.stages.zones import zones

METHOD = Method(
    name="masked-fringe",
    title="Phase shifting under an intensity mask",
    doc="Black and shiny parts at once: bright places are dimmed one by one, and second reflections kept dark.",
    stages=(
        base_exposure,
        pixel_response,
        flat_mask,
        refine.named("refine_1"),
        refine.named("refine_2"),
        pre_exposure,
        zones,
        exposures,
        fringe_capture,
        fusion,
        fringe_phase,
        stereo_cloud.named("first_cloud"),
        band_capture,
        band_phase,
        stereo_cloud,
    ),
    given=(RigFacts, RigCalibration, TableHomography),
    presets={"mask only": {"band_capture.run": "no"}},
)
