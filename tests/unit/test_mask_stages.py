"""The stages of the intensity mask, driven with a rig that exists only as a map and a formula."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from backend.domain.errors import NotFoundError, StageFailedError
from backend.domain.frames import Frame, InMemory
from backend.domain.patterns import Gray, Uniform
from backend.domain.rig import CameraFacts, ProjectorFacts, RigFacts
from backend.domain.shots import Shot
from backend.domain.states import Level
from backend.jobs.rendering import render
from backend.stages.base_exposure import BaseExposureParams, base_exposure
from backend.stages.flat_mask import FlatMaskParams, flat_mask
from backend.stages.mask_making import not_too_dark
from backend.stages.pixel_response import PixelResponseParams, pixel_response
from backend.stages.refine import RefineParams, refine
from backend.stages.table_homography import (
    TableHomography,
    TableHomographyParams,
    table_homography,
)

H, W = 60, 80
PERIOD_MS = 10.0


@dataclass
class MapRig:
    """gray = 4 + gain light t; each camera pixel sees one projector pixel."""

    gain: np.ndarray
    """Gray levels per ms under the white field."""
    u: np.ndarray = field(default_factory=lambda: np.tile(np.arange(W), (H, 1)))
    v: np.ndarray = field(default_factory=lambda: np.tile(np.arange(H)[:, None], (1, W)))
    gamma: float = 1.0
    bit_depth: int = 8
    cameras: tuple[str, ...] = ("left",)
    ambient: float = 0.0
    shots: list[Shot] = field(default_factory=list)

    @property
    def facts(self):
        full_well = 15300.0
        camera = CameraFacts(W, H, self.bit_depth, 1.0, 2000.0, 4.0, full_well, 12.0)
        return RigFacts(
            dict.fromkeys(self.cameras, camera),
            "left",
            ProjectorFacts(W, H, PERIOD_MS, self.gamma),
        )

    def shoot(self, plan):
        try:
            burst = next(plan)
            while True:
                burst = plan.send(tuple(self.expose(shot) for shot in burst))
        except StopIteration as end:
            return end.value

    def expose(self, shot):
        self.shots.append(shot)
        mask = shot.mask.load() if shot.mask else None
        shown = render(shot.pattern, width_px=W, height_px=H, gamma=self.gamma, mask=mask)
        light = (shown / 255.0) ** self.gamma
        full = 2**self.bit_depth - 1
        gray = 4 + (self.gain * light[self.v, self.u] + self.ambient) * shot.exposure_ms
        picture = np.clip(np.rint(gray), 0, full).astype(np.uint8 if full < 256 else np.uint16)
        return {
            name: Frame(
                name,
                shot.pattern,
                shot.exposure_ms,
                InMemory(picture),
                self.bit_depth,
                0.0,
                shot.role,
            )
            for name in shot.cameras or self.cameras
        }


def scene(bright=8.0, dark=0.2, spot=60.0):
    """Make a dark half, a bright half and a highlight in it."""
    gain = np.full((H, W), dark)
    gain[:, W // 2 :] = bright
    gain[20:26, 60:66] = spot
    return gain


def no_array(array_hash):
    raise NotFoundError(f"There is no array {array_hash}.")


def measured(rig):
    base = base_exposure(rig.facts, BaseExposureParams(longest_ms=1000), rig.shoot)
    return base, pixel_response(base, rig.facts, PixelResponseParams(), rig.shoot)


def first_mask(rig, base, response, homography=None, load=no_array, **settings):
    return flat_mask(base, response, homography, rig.facts, None, FlatMaskParams(**settings), load)


def refined(rig, mask, base, response, load=no_array, **settings):
    return refine(mask, response, base, rig.facts, None, RefineParams(**settings), rig.shoot, load)


# base exposure


def test_dark_parts_decide_the_exposure():
    rig = MapRig(scene())
    base = base_exposure(rig.facts, BaseExposureParams(dark_target=0.25), rig.shoot)
    assert base.exposure_ms == pytest.approx(0.25 * 255 / 0.2, rel=0.1)
    assert base.exposure_ms % PERIOD_MS == pytest.approx(0, abs=1e-6)
    assert base.lit["left"].all()
    assert base.saturated_share == pytest.approx(0.5, abs=0.01)


def test_the_search_stops_at_the_longest_exposure_allowed():
    rig = MapRig(scene(dark=0.01))
    base = base_exposure(rig.facts, BaseExposureParams(longest_ms=400), rig.shoot)
    assert base.exposure_ms == pytest.approx(400)
    assert max(shot.exposure_ms for shot in rig.shots) <= 400
    assert base_exposure.check(base, BaseExposureParams())[1].level is Level.WARNING


def test_ambient_light_limits_the_exposure():
    rig = MapRig(scene(), ambient=0.3)
    base = base_exposure(rig.facts, BaseExposureParams(black_field_most=0.2), rig.shoot)
    assert base.black_field_gray <= 0.21 * 255
    assert base.exposure_ms < 170


def test_what_only_scattered_light_reaches_is_not_lit():
    rig = MapRig(scene())
    rig.gain[:10] = 0.0
    base = base_exposure(rig.facts, BaseExposureParams(), rig.shoot)
    assert not base.lit["left"][:10].any()
    assert base.lit["left"][10:].all()


def test_a_scene_that_returns_nothing_is_refused_in_a_sentence():
    with pytest.raises(StageFailedError, match="black or mirror-like"):
        base_exposure(
            MapRig(np.zeros((H, W))).facts, BaseExposureParams(), MapRig(np.zeros((H, W))).shoot
        )


def test_an_exposure_beyond_the_camera_is_refused():
    rig = MapRig(scene())
    with pytest.raises(StageFailedError, match="1 to 2000 ms"):
        base_exposure(rig.facts, BaseExposureParams(exposure_ms=5000), rig.shoot)


# response


@pytest.mark.parametrize("gamma", [1.0, 2.2])
@pytest.mark.parametrize("bit_depth", [8, 12])
def test_the_response_is_that_of_light_whatever_the_gamma(gamma, bit_depth):
    rig = MapRig(scene() * 2 ** (bit_depth - 8), gamma=gamma, bit_depth=bit_depth)
    base, response = measured(rig)
    true = rig.gain * base.exposure_ms / 255
    assert np.median(np.abs(response.gain["left"] / true - 1)) < 0.03
    assert response.unknown_share == 0
    assert response.gamma == gamma


def test_the_ladder_goes_down_as_far_as_bright_pixels_need():
    dull, shiny = MapRig(scene(bright=0.3, spot=0.3)), MapRig(scene())
    _, tame = measured(dull)
    _, wild = measured(shiny)
    assert {row.code_gray for row in tame.fields} == {0, 50, 100, 150, 255}
    assert {25, 12, 6, 3} <= {row.code_gray for row in wild.fields}
    assert (wild.samples["left"][20:26, 60:66] >= 3).all()
    assert [f.pattern.gray for f in wild.frames] == sorted(f.pattern.gray for f in wild.frames)
    assert len(wild.light) == len(wild.frames)


def test_the_papers_fields_alone_can_be_asked_for():
    rig = MapRig(scene(bright=0.3, spot=0.3))
    base = base_exposure(rig.facts, BaseExposureParams(), rig.shoot)
    response = pixel_response(
        base, rig.facts, PixelResponseParams(black_and_white=False), rig.shoot
    )
    assert [row.code_gray for row in response.fields] == [50, 100, 150]


def test_fields_that_no_projector_has_are_refused():
    rig = MapRig(scene())
    base = base_exposure(rig.facts, BaseExposureParams(), rig.shoot)
    with pytest.raises(StageFailedError, match="1 to 255"):
        pixel_response(base, rig.facts, PixelResponseParams(fields=(50, 300)), rig.shoot)


# first mask


def test_without_a_table_nothing_is_dimmed_yet():
    rig = MapRig(scene())
    base, response = measured(rig)
    mask = first_mask(rig, base, response)
    assert (mask.factor == 1).all()
    assert np.isnan(mask.unqualified_share)
    assert mask.proper["left"][23, 63] < 0.02


def test_on_the_table_the_first_mask_is_right_at_once():
    rig = MapRig(scene())
    base, response = measured(rig)
    mask = first_mask(rig, base, response, TableHomography({"left": np.eye(3)}, 0.1), dilation_px=1)
    assert np.allclose(mask.factor[:, :36], 1, atol=1e-3)
    assert mask.factor[23, 63] == pytest.approx(mask.proper["left"][23, 63], rel=0.05)
    tried = refined(rig, mask, base, response, run="no", scale=0.999)
    assert tried.unqualified_share == 0


def test_an_uncalibrated_rig_widens_as_the_paper_does():
    rig = MapRig(scene())
    base, response = measured(rig)
    mask = first_mask(rig, base, response, TableHomography({"left": np.eye(3)}, 0.1))
    assert mask.dilation_px == 5
    assert mask.factor[23, 56] < 0.02
    assert mask.factor[23, 52] > 0.02


def test_a_table_of_another_camera_is_refused():
    rig = MapRig(scene())
    base, response = measured(rig)
    with pytest.raises(StageFailedError, match=r"measured with right, not with camera 'left'"):
        first_mask(rig, base, response, TableHomography({"right": np.eye(3)}, 0.1))


# refinement


def shifted_rig(**options):
    """Make a rig whose surface isn't where the table says: everything 9 px to the left in the projector."""
    rig = MapRig(scene(), **options)
    rig.u = np.clip(rig.u - 9, 0, W - 1)
    return rig


@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_one_refinement_finds_where_pixels_look(gamma):
    rig = shifted_rig(gamma=gamma)
    base, response = measured(rig)
    mask = refined(rig, first_mask(rig, base, response), base, response)
    known = ~np.isnan(mask.projector_px["left"])
    inner = np.zeros_like(known)
    inner[2:-2, 12:-2] = True
    assert known[inner].mean() > 0.99
    assert np.abs(mask.projector_px["left"] - rig.u)[known & inner].max() <= 1.5
    assert np.abs(mask.projector_row_px["left"] - rig.v)[known & inner].max() <= 1.5
    assert mask.factor[23, 54] < 0.02
    assert mask.factor[23, 20] == 1
    assert mask.unqualified_share < 0.02
    assert [row.mask for row in mask.rounds] == ["no mask", "refinement 1"]
    assert mask.rounds[0].unqualified_share > 0.4 > mask.rounds[1].unqualified_share


def test_twelve_bits_are_refined_alike():
    rig = shifted_rig(bit_depth=12)
    rig.gain = rig.gain * 16
    base, response = measured(rig)
    mask = refined(rig, first_mask(rig, base, response), base, response)
    assert mask.unqualified_share < 0.02


def test_a_wrong_first_mask_is_put_right():
    rig = shifted_rig()
    base, response = measured(rig)
    wrong = first_mask(
        rig, base, response, TableHomography({"left": np.eye(3)}, 0.1), dilation_px=1
    )
    mask = refined(rig, wrong, base, response)
    assert mask.rounds[0].mask == "first mask"
    assert mask.unqualified_share < 0.02 < mask.rounds[0].unqualified_share


def test_what_is_good_enough_is_left_alone():
    rig = shifted_rig()
    base, response = measured(rig)
    once = refined(rig, first_mask(rig, base, response), base, response)
    taken = len(rig.shots)
    again = refined(rig, once, base, response, enough=0.1)
    assert again is once
    assert len(rig.shots) == taken
    more = refined(rig, once, base, response, run="yes")
    assert more.round == 2
    assert [row.mask for row in more.rounds] == ["no mask", "refinement 1", "refinement 2"]


def test_a_mask_for_two_cameras_dazzles_neither():
    rig = MapRig(scene(), cameras=("left", "right"))
    base, response = measured(rig)
    mask = refined(rig, first_mask(rig, base, response), base, response)
    assert set(mask.white) == {"left", "right"}
    one = refined(rig, first_mask(rig, base, response), base, response, cameras="reference")
    assert set(one.white) == {"left"}


def test_the_same_frames_lead_to_the_same_mask():
    masks = []
    for _ in range(2):
        rig = shifted_rig()
        base, response = measured(rig)
        masks.append(refined(rig, first_mask(rig, base, response), base, response))
    assert np.array_equal(masks[0].factor, masks[1].factor)


# by hand


def test_a_painted_mask_replaces_what_is_painted():
    rig = MapRig(scene())
    base, response = measured(rig)
    picture = np.full((H, W), np.nan, np.float32)
    picture[:, :10] = 0.25
    mask = first_mask(rig, base, response, load=lambda _: picture, paint="a" * 64, scale=0.5)
    assert np.allclose(mask.factor[:, :10], 0.125)
    assert np.allclose(mask.factor[:, 10:], 0.5)


def test_gray_levels_can_be_painted():
    rig = MapRig(scene())
    base, response = measured(rig)
    picture = np.full((H, W), 51, np.uint8)
    mask = first_mask(rig, base, response, load=lambda _: picture, paint="a" * 64)
    assert np.allclose(mask.factor, 0.2)


def test_a_painting_of_another_size_is_refused():
    rig = MapRig(scene())
    base, response = measured(rig)
    with pytest.raises(StageFailedError, match="paint it at the projector's size"):
        first_mask(rig, base, response, load=lambda _: np.zeros((4, 5), np.float32), paint="a" * 64)


def test_what_is_changed_by_hand_is_tried_but_not_refined():
    rig = shifted_rig()
    base, response = measured(rig)
    once = refined(rig, first_mask(rig, base, response), base, response)
    rig.shots.clear()
    dimmer = refined(rig, once, base, response, run="no", scale=0.03)
    assert dimmer.round == 1
    assert dimmer.rounds[-1].mask == "by hand"
    assert dimmer.rounds[-1].under_exposed_share > 0.3
    assert not any(isinstance(shot.pattern, Gray) for shot in rig.shots)


def test_a_mask_that_darkens_everything_fails_its_check():
    rig = MapRig(scene())
    base, response = measured(rig)
    mask = first_mask(rig, base, response)
    dark = replace(mask, factor=np.full((H, W), 0.001, np.float32))
    check = not_too_dark(dark, FlatMaskParams())
    assert check.level is Level.FAILURE
    assert "darkens nearly everything" in check.sentence
    assert not_too_dark(mask, FlatMaskParams()).level is Level.OK


# the table


def test_the_table_is_found_behind_a_part_that_stands_on_it():
    rig = MapRig(np.full((H, W), 2.0))
    rig.u = np.clip(np.rint(rig.u * 0.8 + 5), 0, W - 1).astype(int)
    rig.u[20:40, 20:45] += 9
    base = base_exposure(rig.facts, BaseExposureParams(), rig.shoot)
    found = table_homography(base, rig.facts, TableHomographyParams(), rig.shoot)
    assert found.projector_from_camera["left"] == pytest.approx(
        np.array([[0.8, 0, 5], [0, 1, 0], [0, 0, 1]]), abs=0.05
    )
    assert found.rms_px < 0.5
    assert 0.85 < found.table[0].table_share < 0.92
    assert np.nanmedian(found.off_plane_px["left"][22:38, 22:43]) == pytest.approx(9, abs=0.5)
    levels = {c.name: c.level for c in table_homography.check(found, TableHomographyParams())}
    assert levels == {"residual": Level.OK, "table in view": Level.OK}


def test_no_table_in_view_is_said_in_a_sentence():
    rig = MapRig(np.zeros((H, W)))
    base = base_exposure(MapRig(scene()).facts, BaseExposureParams(), MapRig(scene()).shoot)
    with pytest.raises(StageFailedError, match="No table in view: camera 'left'"):
        table_homography(base, rig.facts, TableHomographyParams(), rig.shoot)


def test_a_rig_without_a_projector_is_told_so():
    facts = replace(MapRig(scene()).facts, projector=None)
    with pytest.raises(StageFailedError, match="no projector"):
        base_exposure(facts, BaseExposureParams(), MapRig(scene()).shoot)


def test_the_white_field_is_not_shown_brighter_than_the_mask_allows():
    rig = shifted_rig()
    base, response = measured(rig)
    mask = refined(rig, first_mask(rig, base, response), base, response)
    last = [s for s in rig.shots if isinstance(s.pattern, Uniform)][-1]
    assert last.mask is not None
    assert np.array_equal(last.mask.load(), mask.factor)
    assert (mask.white["left"] < 254).mean() > 0.98
