"""Real reflections: a heliostat's facet with its known figures, finger prints on glass."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from backend.cli.application import run

pytestmark = pytest.mark.skipif(
    "UNGLARE_DATA" not in os.environ, reason="UNGLARE_DATA names no folder of real captures"
)


@pytest.fixture
def reflect(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch):
    """Run the command on a real capture; return its answer and its folder."""
    monkeypatch.setenv("UNGLARE_DATA_FOLDER", str(tmp_path / "data"))

    def command(path: str, *arguments: str) -> tuple[dict[str, Any], Path]:
        out = tmp_path / f"out-{len(list(tmp_path.iterdir()))}"
        file = Path(os.environ["UNGLARE_DATA"]) / path
        status = run(["reflect", str(file), "--out", str(out), *arguments, "--json", "--quiet"])
        answer = json.loads(capsys.readouterr().out.splitlines()[-1])
        assert status == 0, answer["error"]
        return answer, out

    return command


def test_the_facet_has_its_known_figures(reflect):
    answer, out = reflect("sofast-facet/facet_input.npz")
    assert answer["focal_lengths_m"] == pytest.approx([120.0, 108.9], rel=0.01)
    assert answer["rms_slopes_mrad"] == pytest.approx([1.57, 1.74], rel=0.01)
    assert answer["ramp_belongs"] is False
    assert any("ramp on file doesn't belong" in sentence for sentence in answer["findings"])
    assert max(answer["ripple_mrad"][axis]["15.9"] for axis in ("x", "y")) < 3
    assert answer["bad_frames"] == []
    result = np.load(out / "result.npz")
    assert result["slopes"].shape == (2, 7105)
    assert np.isfinite(result["slopes"]).all()
    assert 0.25 / result["surf_coefs"][[2, 5]] == pytest.approx([120.0, 108.9], rel=0.01)


def test_the_facets_outline_tells_its_pose_too(reflect):
    answer, _out = reflect("sofast-facet/facet_input.npz", "--set", "slopes.pose=outline")
    assert answer["pose_from"] == "outline"
    assert answer["focal_lengths_m"] == pytest.approx([120.0, 108.9], rel=0.01)


@pytest.mark.parametrize("frame", [0, 5, 14, 18, 31])
def test_a_defective_frame_among_the_real_ones_is_named(tmp_path, reflect, frame):
    arrays = dict(np.load(Path(os.environ["UNGLARE_DATA"]) / "sofast-facet/facet_input.npz"))
    arrays["fringe_images"] = arrays["fringe_images"].copy()
    arrays["fringe_images"][frame] = 0.6 * arrays["fringe_images"][frame]
    np.savez(tmp_path / "bad.npz", **arrays)
    answer, _out = reflect(tmp_path / "bad.npz")
    assert answer["bad_frames"] == [frame]
    assert answer["focal_lengths_m"] == pytest.approx([120.0, 108.9], rel=0.01)


@pytest.mark.parametrize(
    ("name", "limit_rad", "valid_share"), [("phone", 0.08, 0.9), ("coffee-glass", 0.04, 0.6)]
)
def test_phases_of_glass_are_repeated(reflect, name, limit_rad, valid_share):
    phases = []
    for left_out in (4, 0):
        _answer, out = reflect(
            f"deflect-4step-glass/capture-{name}.json",
            *("--set", f"screen_phase.leave_out=[{left_out}]"),
            *("--set", "screen_phase.modulation_min_gray=8"),
            *("--set", "screen_phase.saturation_gray=250"),
        )
        phases.append(np.load(out / "maps/screen_phase.finest_rad.main.npy"))
    difference = (phases[0] - phases[1] + np.pi) % (2 * np.pi) - np.pi
    known = np.isfinite(difference)
    assert known.mean() > valid_share
    assert np.sqrt(np.mean(difference[known] ** 2)) <= limit_rad
    assert (out / "defects.png").stat().st_size > 100_000
