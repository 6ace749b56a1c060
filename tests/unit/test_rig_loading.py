"""Rigs by name: each wrong name or option ends in one sentence with the way out."""

import sys
from importlib.metadata import EntryPoint, EntryPoints

import pytest

from backend.devices import loading
from backend.devices import plug_ins as plug_ins_module
from backend.devices.errors import RigConfigError, RigNotFoundError
from backend.devices.loading import available_rigs, open_rig
from backend.devices.sim import SimulatedRig


class _Toy:
    options: object = None

    def _anything(self, *arguments):
        return None

    name = info = cameras = projector = "x"
    open = close = facts = calibration = __enter__ = __exit__ = _anything


def make_toy(options):
    toy = _Toy()
    toy.options = options
    return toy


def make_nothing(options):
    return None


def explode(options):
    raise RuntimeError("no licence")


not_callable = 3


@pytest.fixture
def plug_ins(monkeypatch):
    entries = EntryPoints(
        EntryPoint(name, f"{__name__}:{attribute}", loading.GROUP)
        for name, attribute in (("toy", "make_toy"), ("broken", "no_such_thing"))
    )
    monkeypatch.setattr(plug_ins_module, "entry_points", lambda group: entries)
    monkeypatch.setitem(sys.modules, __name__, sys.modules[__name__])


def test_the_simulated_rig_is_built_in():
    assert available_rigs()[0].name == "simulated"
    rig = open_rig("simulated", {"scene": "plane", "size": "640x480"})
    assert isinstance(rig, SimulatedRig)
    assert rig.config.size == (640, 480)


def test_a_plug_in_opens_and_a_broken_one_does_not_stop_it(plug_ins):
    assert [rig.name for rig in available_rigs()] == ["simulated", "sim-lcd", "broken", "toy"]
    assert getattr(open_rig("toy", {"a": 1}), "options", None) == {"a": 1}
    with pytest.raises(RigConfigError, match=r"rig broken can't be loaded.*no_such_thing"):
        open_rig("broken")


def test_a_factory_by_its_module(plug_ins):
    assert getattr(open_rig(f"{__name__}:make_toy"), "options", None) == {}


@pytest.mark.parametrize(
    ("name", "error", "sentence"),
    [
        ("nowhere", RigNotFoundError, "choose simulated"),
        ("no_such_package.rigs:make", RigNotFoundError, "no_such_package"),
        ("json:no_such_factory", RigNotFoundError, "no_such_factory"),
        ("here:not_callable", RigNotFoundError, "is a int"),
        ("here:make_nothing", RigConfigError, "returned a NoneType without name"),
        ("here:explode", RigConfigError, "RuntimeError: no licence"),
    ],
)
def test_what_is_no_rig_is_refused(plug_ins, name, error, sentence):
    with pytest.raises(error, match=sentence) as caught:
        open_rig(name.replace("here:", f"{__name__}:"))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"sceen": "metal"}, "no option 'sceen'"),
        ({"scene": "mettal"}, "no scene 'mettal'; choose high-contrast"),
        ({"scene": "sprayed:mettal"}, "no scene 'sprayed:mettal'"),
        ({"size": "10x10"}, "size can't be '10x10'"),
        ({"size": "wide"}, "size can't be 'wide'"),
        ({"cameras": 3}, "cameras can't be 3"),
        ({"bit_depth": 10}, "10 is not one of 8, 12"),
        ({"samples": 3}, "3 is not one of 1, 4, 16"),
        ({"glare_share": "much"}, "glare_share"),
        ({"full_well_e": float("nan")}, "full_well_e"),
        ({"exposure_min_ms": 5, "exposure_max_ms": 4}, "not above exposure_min_ms 5"),
        ({"fault_device": "top"}, "top is not left or right"),
    ],
)
def test_bad_options_of_the_simulated_rig_are_refused(options, sentence):
    with pytest.raises(RigConfigError, match=sentence) as caught:
        open_rig("simulated", options)
    assert "\n" not in str(caught.value)


def test_options_may_be_text():
    rig = open_rig("simulated", {"size": "64x48", "seed": "7", "realtime": "false", "gamma": "2.2"})
    assert isinstance(rig, SimulatedRig)
    config = rig.config
    assert (config.size, config.seed, config.realtime, config.gamma) == ((64, 48), 7, False, 2.2)


@pytest.mark.parametrize(
    ("scene", "method", "rig"),
    [
        (None, "hdr-fringe", "simulated"),
        (None, "fringe-reflection", "sim-lcd"),
        ("metal", "hdr-fringe", "simulated"),
        ("mirror-dent", "fringe-reflection", "sim-lcd"),
        ("mirror:facet.npy", "hdr-fringe", "sim-lcd"),
        ("mesh:mirror-flat.ply", "fringe-reflection", "simulated"),
    ],
)
def test_scenes_and_methods_find_their_rig(scene, method, rig):
    assert loading.rig_for(scene, method) == rig


@pytest.mark.parametrize(
    ("rig", "method"),
    [
        ("simulated", "hdr-fringe"),
        ("sim-lcd", "fringe-reflection"),
        ("my-station", "hdr-fringe"),
        ("somewhere.else:factory", "hdr-fringe"),
    ],
)
def test_a_rig_says_which_method_it_is_made_for(rig, method):
    assert loading.method_for(rig) == method
