"""A whole scan by the projector's clock: a rig file, a LightCrafter that plays from flash, cameras on its trigger line."""

from pathlib import Path

import pytest
import yaml

from backend.contract.requests import CreateScan
from backend.devices import dlpc350_protocol as protocol
from backend.devices.drivers.aravis_library import AravisMissingError, aravis
from backend.devices.pattern_set import NewPattern, write_set
from backend.devices.peers.dlpc350 import SimulatedDlpc350
from backend.devices.sim.projector import SimulatedProjector
from backend.devices.sim.renderer import Shown
from backend.domain.patterns import BLACK, WHITE, Pattern
from backend.domain.rig import ProjectorFacts, RigCalibration
from backend.domain.states import StageStatus
from backend.jobs.rendering import render
from backend.stages.exposures import ExposuresParams, _design
from tests.lightcrafter_hardware import lightcrafter_hardware
from tests.scans.houses import real_house, run_unattended, stage_of

try:
    aravis()
except AravisMissingError as error:
    pytest.skip(str(error), allow_module_level=True)

pytestmark = pytest.mark.scan

WIDTH, HEIGHT = protocol.SIZE_PX


def stored(folder: Path, *patterns: Pattern) -> Path:
    pictures = [render(p, width_px=WIDTH, height_px=HEIGHT) for p in patterns]
    write_set(folder, [NewPattern(p, "pattern") for p in pictures], pack=True)
    return folder


def written(calibration: RigCalibration) -> dict[str, object]:
    """Write a calibration as a rig file has it."""
    views = {
        name: {
            "width_px": model.width_px,
            "height_px": model.height_px,
            "K": model.K.tolist(),
            "distortion": model.distortion.tolist(),
            "R": calibration.camera_from_world[name].R.tolist(),
            "t_mm": calibration.camera_from_world[name].t_mm.tolist(),
        }
        for name, model in calibration.cameras.items()
    }
    return {"cameras": views}


@pytest.mark.parametrize("unplugged_at", [None, 24], ids=["undisturbed", "unplugged"])
def test_a_scan_plays_from_flash_and_every_frame_comes(tmp_path, addresses, unplugged_at):
    """Also where the cable is pulled in the middle of a sequence: the scan takes the device back and goes on."""
    fringes = _design(ExposuresParams()).patterns(ProjectorFacts(WIDTH, HEIGHT))
    folder = stored(tmp_path / "set", *fringes, WHITE, BLACK)
    with lightcrafter_hardware(addresses, folder) as (device, simulated):
        device.listen(str(tmp_path / "lcr"))
        edges = count_edges(simulated.projector, device, unplugged_at)
        calibration = simulated.calibration()
        assert calibration is not None
        cameras = {
            name: {
                "driver": "aravis",
                "address": address,
                "trigger_line": "Line1",
                "sensor": {"black_level_gray": 4.0, "full_well_e": 15_300.0, "read_noise_e": 12.0},
            }
            for name, address in zip(("left", "right"), addresses, strict=True)
        }
        projector = {
            "driver": "dlpc350",
            "patterns": str(folder),
            "transport": f"unix:{tmp_path / 'lcr'}",
        }
        rig = {"cameras": cameras, "projector": projector, "calibration": written(calibration)}
        data = tmp_path / "data"
        (data / "rigs").mkdir(parents=True)
        (data / "rigs" / "bench.yaml").write_text(yaml.safe_dump(rig))
        with real_house(data) as services:
            one_exposure = {"exposures": {"exposures_ms": [25.0]}}
            request = CreateScan(method="hdr-fringe", rig="bench", settings=one_exposure)
            made = services.create_scan(request, "test")
            state = run_unattended(services, made.id)
        assert device.late_images == 0
        assert device.served_clients == (1 if unplugged_at is None else 2)
    assert {stage.status for stage in state.stages} == {StageStatus.DONE}, state
    assert stage_of(state, "stereo_cloud").message
    assert state.job is not None
    assert state.job.error is None
    assert len(edges) > len(fringes)


def count_edges(
    lamp: SimulatedProjector, device: SimulatedDlpc350, unplugged_at: int | None
) -> list[float]:
    """Note the edges of the trigger line, and pull the cable at one of them."""
    times_s: list[float] = []
    fire = lamp.trigger_lines[0]

    def noting(shown: Shown, time_s: float, shown_us: float) -> None:
        times_s.append(time_s)
        if len(times_s) == unplugged_at:
            device.unplug()
        fire(shown, time_s, shown_us)

    lamp.trigger_lines[0] = noting
    return times_s
