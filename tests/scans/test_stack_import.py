"""An exposure stack from a folder: its response, and what can't be learned from a bad one."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from backend.devices.sim.chains import CHAINS
from backend.domain.errors import InvalidCaptureError
from backend.domain.states import StageStatus
from tests.scans.houses import real_house, run_unattended, stage_of

pytestmark = pytest.mark.scan

EXPOSURES_MS = (500.0, 100.0, 1000 / 30, 1000 / 60, 12.5, 10.0)
"""The paper's."""


def folder_of_stack(folder: Path, exposures_ms: tuple[float, ...], *, light: float = 1.0) -> Path:
    chain, rng = CHAINS["D"], np.random.default_rng(3)
    scene = light * np.exp(rng.uniform(np.log(0.02), 0.0, (80, 100)))
    frames: list[dict[str, Any]] = []
    for i, exposure_ms in enumerate(exposures_ms):
        gray = chain.gray(scene, exposure_ms / 50.0, rng)
        cv2.imwrite(str(folder / f"{i}.png"), gray)
        frames.append(
            {
                "file": f"{i}.png",
                "camera": "canon",
                "exposure_ms": exposure_ms,
                "pattern": {"kind": "picture"},
                "stage": "stack",
            }
        )
    document = {
        "format": "unglare-capture",
        "version": 1,
        "name": "stack",
        "method": "fringe-reflection",
        "cameras": {"canon": {"width_px": 100, "height_px": 80, "bit_depth": 8}},
        "frames": frames,
    }
    file = folder / "capture.json"
    file.write_text(json.dumps(document))
    return file


def test_the_papers_six_exposures_give_a_response_without_a_rig(tmp_path: Path) -> None:
    with real_house(tmp_path / "data") as services:
        imported = services.import_capture(str(folder_of_stack(tmp_path, EXPOSURES_MS)), "", "test")
        assert stage_of(imported, "stack").status is StageStatus.GIVEN
        state = run_unattended(services, imported.id)

    assert stage_of(state, "camera_response").status is StageStatus.DONE
    assert stage_of(state, "ramp").status is StageStatus.UNAVAILABLE
    levels = {check.level.value for check in stage_of(state, "camera_response").checks}
    assert levels == {"ok"}


@pytest.mark.parametrize(
    ("exposures_ms", "light", "sentence"),
    [
        ((20.0,), 1.0, "one exposure, 20 ms"),
        ((20.0, 20.0), 1.0, "one exposure, 20 ms"),
        (EXPOSURES_MS, 1e4, "All pixels of the stack are clipped"),
    ],
    ids=["one picture", "one exposure", "all clipped"],
)
def test_stacks_that_tell_nothing_are_refused_in_a_sentence(
    tmp_path: Path, exposures_ms: tuple[float, ...], light: float, sentence: str
) -> None:
    file = folder_of_stack(tmp_path, exposures_ms, light=light)

    with (
        real_house(tmp_path / "data") as services,
        pytest.raises(InvalidCaptureError, match=sentence),
    ):
        services.import_capture(str(file), "", "test")
