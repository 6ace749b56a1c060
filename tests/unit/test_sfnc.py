"""GenICam features by their standard names, and by older ones, whichever library reads them."""

from collections.abc import Mapping
from dataclasses import replace

import pytest

from backend.devices.drivers.extras import _cure
from backend.devices.drivers.sfnc import SfncControls, SfncOptions
from backend.devices.errors import FeatureError, UnsupportedFeature
from backend.devices.protocols import CameraSettings, Range, TriggerSource

Numbers = Mapping[str, tuple[float, float, float, float, str]]
"""Value, smallest, largest, step, unit."""
Texts = Mapping[str, tuple[str, tuple[str, ...]]]
"""Value, choices."""


class FakeFeatures:
    """A camera's description in memory: numbers with bounds, enumerations with choices."""

    def __init__(self, numbers: Numbers, texts: Texts) -> None:
        self.numbers = {name: value[0] for name, value in numbers.items()}
        self.limits = {name: (*value[1:4],) for name, value in numbers.items()}
        self.units = {name: value[4] for name, value in numbers.items()}
        self.texts = {name: value for name, (value, _) in texts.items()}
        self.offers = {name: choices for name, (_, choices) in texts.items()}
        self.log: list[tuple[str, object]] = []

    def has(self, name: str) -> bool:
        return name in self.numbers or name in self.texts

    def choices(self, name: str) -> tuple[str, ...]:
        return self.offers.get(name, ())

    def text(self, name: str) -> str:
        return self.texts[name]

    def number(self, name: str) -> float:
        return self.numbers[name]

    def flag(self, name: str) -> bool:
        return self.texts[name] == "on"

    def set_flag(self, name: str, *, value: bool) -> None:
        self.set_text(name, "on" if value else "off")

    def bounds(self, name: str) -> tuple[float, float, float]:
        low, high, step = self.limits[name]
        return low, high, step

    def unit(self, name: str) -> str:
        return self.units[name]

    def set_text(self, name: str, value: str) -> None:
        assert value in self.offers[name]
        locked = name == "TriggerSource" and self.texts["TriggerMode"] == "On"
        assert not locked, "some cameras lock it then"
        self.texts[name] = value
        self.log.append((name, value))

    def set_number(self, name: str, value: float) -> None:
        low, high, step = self.limits[name]
        assert low <= value <= high
        if step and abs((value - low) / step - round((value - low) / step)) > 1e-6:
            raise ValueError(f"{name} {value} is between two steps")
        self.numbers[name] = value
        self.log.append((name, value))

    def run(self, name: str) -> None:
        self.log.append((name, None))


SIZE = {"Width": (640.0, 16, 640, 16, ""), "Height": (480.0, 1, 480, 1, "")}
FORMAT = {"PixelFormat": ("Mono8", ("Mono8", "Mono12", "Mono12p"))}
OLD_NAMES = {"ExposureTimeAbs": (5000.0, 20, 1e6, 1, "us")}
TRIGGER = {
    "TriggerSelector": ("AcquisitionStart", ("AcquisitionStart", "FrameStart")),
    "TriggerMode": ("On", ("Off", "On")),
    "TriggerSource": ("Line1", ("Software", "Line1", "Line3", "Action1")),
}


def controls(
    numbers: Numbers,
    texts: Texts,
    **options: object,
) -> tuple[SfncControls, FakeFeatures]:
    features = FakeFeatures({**SIZE, **numbers}, {**FORMAT, **texts})
    made = SfncControls(
        "left",
        features,
        SfncOptions.model_validate(options),
        buffered_frames=3,
        hardware_timestamp=False,
    )
    made.prepare()
    return made, features


def test_old_names_serve_where_there_are_no_new_ones():
    made, features = controls({**OLD_NAMES, "GainAbs": (0.0, 0, 20, 0, "")}, TRIGGER)
    can = made.capabilities()
    assert can.exposure_us == Range(20, 1e6, 1, "us")
    assert can.gain_db == Range(0, 20, 0, "dB")
    taken = made.apply(replace(made.read(), exposure_us=9000.0, gain_db=6.0), made.read())
    assert (features.numbers["ExposureTimeAbs"], features.numbers["GainAbs"]) == (9000.0, 6.0)
    assert (taken.exposure_us, taken.gain_db) == (9000.0, 6.0)


def test_new_names_go_before_old_ones():
    made, features = controls({**OLD_NAMES, "ExposureTime": (70.0, 10, 500, 0, "us")}, TRIGGER)
    made.apply(replace(made.read(), exposure_us=100.0), made.read())
    assert features.numbers["ExposureTimeAbs"] == 5000.0


@pytest.mark.parametrize(
    ("gain", "options", "expected"),
    [
        ({"GainRaw": (300.0, 200, 1000, 1, "")}, {}, (Range(0, 0, 0, "dB"), 0.0)),
        ({"GainRaw": (300.0, 200, 1000, 1, "")}, {"gain_db_per_step": 0.0359}, (Range(0, 28.72, 0.0359, "dB"), 3.59)),
        ({"Gain": (1.0, 1, 16, 0.1, "x")}, {}, (Range(0, 0, 0, "dB"), 0.0)),
        ({"Gain": (1.5, 0, 48, 0.1, "dB")}, {}, (Range(0, 48, 0.1, "dB"), 1.5)),
    ],
    ids=["raw", "raw, steps known", "factor", "dB"],
)  # fmt: skip
def test_a_gain_that_is_not_in_db_stays_as_it_is(gain, options, expected):
    made, _ = controls({**OLD_NAMES, **gain}, TRIGGER, **options)
    allowed, now_db = expected
    assert made.capabilities().gain_db.max == pytest.approx(allowed.max)
    assert made.capabilities().gain_db.inc == pytest.approx(allowed.inc)
    assert made.read().gain_db == pytest.approx(now_db)


def test_a_raw_gain_is_set_in_its_own_steps():
    made, features = controls({**OLD_NAMES, "GainRaw": (300.0, 200, 1000, 1, "")}, TRIGGER, gain_db_per_step=0.05)  # fmt: skip
    taken = made.apply(replace(made.read(), gain_db=6.01), made.read())
    assert features.numbers["GainRaw"] == 320
    assert taken.gain_db == pytest.approx(6.0)


def test_exposures_between_two_steps_are_rounded():
    made, features = controls({"ExposureTime": (70.0, 10, 1e6, 20, "us")}, TRIGGER)
    taken = made.apply(replace(made.read(), exposure_us=16_683.0), made.read())
    assert taken.exposure_us == features.numbers["ExposureTime"] == 16_690.0


def test_what_a_camera_refuses_leaves_the_old_settings(monkeypatch):
    made, features = controls({**OLD_NAMES, "GainAbs": (0.0, 0, 20, 0, "")}, TRIGGER)
    before, set_number = made.read(), features.set_number

    def without_gain(name: str, value: float) -> None:
        if name == "GainAbs":
            raise ValueError("no")
        set_number(name, value)

    monkeypatch.setattr(features, "set_number", without_gain)
    with pytest.raises(ValueError, match="no"):
        made.apply(replace(before, exposure_us=9000.0, gain_db=6.0), before)
    assert made.read() == before


SWITCH = ("off", "on")


@pytest.mark.parametrize(
    ("numbers", "texts", "feature", "set_to", "sentence"),
    [
        ({}, {"ExposureAuto": ("Continuous", ("Off", "Once", "Continuous"))}, "ExposureAuto", "Off", "ExposureAuto was Continuous and is Off now"),
        ({}, {"GainAuto": ("Once", ("Off", "Once"))}, "GainAuto", "Off", "gains change from frame to frame"),
        ({}, {"TestPattern": ("GreyDiagonalRamp", ("Off", "GreyDiagonalRamp"))}, "TestPattern", "Off", "test images"),
        ({}, {"SequencerMode": ("On", ("Off", "On"))}, "SequencerMode", "Off", "SequencerMode was On"),
        ({}, {"BalanceWhiteAuto": ("Continuous", ("Off", "Continuous"))}, "BalanceWhiteAuto", "Off", "colours"),
        ({}, {"GammaEnable": ("on", SWITCH)}, "GammaEnable", "off", "left: GammaEnable was on and is off now"),
        ({}, {"LUTEnable": ("on", SWITCH)}, "LUTEnable", "off", "aren't proportional"),
        ({}, {"ReverseX": ("on", SWITCH)}, "ReverseX", "off", "mirrored, which no calibration knows"),
        ({}, {"ReverseY": ("on", SWITCH)}, "ReverseY", "off", "upside down"),
        ({}, {"AcquisitionFrameRateEnable": ("on", SWITCH)}, "AcquisitionFrameRateEnable", "off", "passed over"),
        ({"DigitalShift": (2.0, 0, 4, 1, "")}, {}, "DigitalShift", 0.0, "DigitalShift was 2 and is 0 now"),
        ({"TriggerDelay": (500.0, 0, 1e6, 0, "us")}, {}, "TriggerDelay", 0.0, "exposes later"),
        ({"Gamma": (0.45, 0, 4, 0, "")}, {}, "Gamma", 1.0, "Gamma was 0.45 and is 1 now"),
        ({}, {"GammaSelector": ("sRGB", ("User", "sRGB"))}, "GammaSelector", "User", "GammaSelector was sRGB"),
    ],
)  # fmt: skip
def test_what_a_viewer_left_on_is_set_and_told(numbers, texts, feature, set_to, sentence):
    made, features = controls({**OLD_NAMES, **numbers}, {**TRIGGER, **texts})
    assert {**features.texts, **features.numbers}[feature] == set_to
    assert len(made.left_on.corrected) == 1
    assert sentence in made.left_on.corrected[0]
    assert made.left_on.remaining == ()
    assert made.notes() == made.left_on.corrected
    made.prepare()
    assert not made.left_on.corrected, "nothing to tell a second time"


@pytest.mark.parametrize(
    ("texts", "sentence"),
    [
        ({"ExposureAuto": ("Continuous", ("Once", "Continuous"))}, "left: ExposureAuto is Continuous and can't be set to Off"),
        ({"TestPattern": ("Ramp", ("Ramp",))}, "TestPattern is Ramp and can't be set to Off .*its pictures are test images; set it"),
    ],
)  # fmt: skip
def test_what_spoils_every_scan_and_stays_on_is_refused(texts, sentence):
    with pytest.raises(FeatureError, match=sentence):
        controls(OLD_NAMES, {**TRIGGER, **texts})


def test_what_stays_on_otherwise_is_a_remark(monkeypatch):
    monkeypatch.setattr(FakeFeatures, "set_flag", _locked)
    made, _ = controls(OLD_NAMES, {**TRIGGER, "ReverseX": ("on", SWITCH)})
    (remark,) = made.left_on.remaining
    assert remark.startswith(
        "left: ReverseX is on and can't be set to off (locked by the user set): pictures are"
    )
    assert not made.left_on.corrected


def _locked(self: FakeFeatures, name: str, *, value: bool) -> None:
    raise ValueError("locked by the user set")


def test_a_tone_curve_that_cannot_be_taken_off_is_a_remark():
    made, locked = controls({**OLD_NAMES, "Gamma": (0.45, 0, 0.5, 0, "")}, TRIGGER)
    assert locked.numbers["Gamma"] == 0.45
    assert "Gamma is 0.45 and can't be set to 1" in made.left_on.remaining[0]


def test_a_tone_curve_that_is_switched_off_is_no_matter():
    gamma = {"Gamma": (0.45, 0, 0.5, 0, "")}
    made, features = controls({**OLD_NAMES, **gamma}, {**TRIGGER, "GammaEnable": ("on", SWITCH)})
    assert features.texts["GammaEnable"] == "off"
    assert made.left_on.remaining == ()


def test_a_delay_that_cannot_be_shorter_is_no_matter():
    made, features = controls({**OLD_NAMES, "TriggerDelay": (9.0, 9, 1e6, 0, "us")}, TRIGGER)
    assert made.left_on.remaining == made.left_on.corrected == ()
    made, features = controls({**OLD_NAMES, "TriggerDelay": (500.0, 9, 1e6, 0, "us")}, TRIGGER)
    assert features.numbers["TriggerDelay"] == 9.0
    assert "TriggerDelay was 500 and is 9 now" in made.left_on.corrected[0]


class Running(FakeFeatures):
    """Still streaming for an owner that was killed, its sequencer in force."""

    is_acquiring = True

    def set_text(self, name: str, value: str) -> None:
        if self.is_acquiring:
            raise ValueError(f"{name} is locked while acquisition runs")
        if self.texts["SequencerMode"] == "On" and name != "SequencerMode":
            raise ValueError(f"{name} is locked by the sequencer")
        super().set_text(name, value)

    def run(self, name: str) -> None:
        super().run(name)
        self.is_acquiring = self.is_acquiring and name != "AcquisitionStop"


class Hiding(FakeFeatures):
    """Has an exposure time and a gain only where nothing else sets them."""

    def has(self, name: str) -> bool:
        hidden = {
            "ExposureTime": self.texts["ExposureMode"] != "Timed",
            "Gain": self.texts["GainAuto"] != "Off",
        }
        return super().has(name) and not hidden.get(name, False)


def test_what_an_automatic_hides_is_there_once_it_is_off():
    features = Hiding(
        {
            **SIZE,
            "ExposureTime": (70.0, 10, 1e6, 0, "us"),
            "Gain": (0.0, 0, 20, 0, "dB"),
        },
        {
            **FORMAT,
            **TRIGGER,
            "ExposureMode": ("TriggerWidth", ("Timed", "TriggerWidth")),
            "GainAuto": ("Continuous", ("Off", "Continuous")),
        },
    )
    made = SfncControls(
        "left", features, SfncOptions(), buffered_frames=3, hardware_timestamp=False
    )
    made.prepare()
    assert made.capabilities().exposure_us == Range(10, 1e6, 0, "us")
    assert made.capabilities().gain_db == Range(0, 20, 0, "dB")


def test_a_camera_that_still_runs_is_stopped_before_anything_is_set():
    features = Running(
        {**SIZE, **OLD_NAMES},
        {
            **FORMAT,
            **TRIGGER,
            "SequencerMode": ("On", ("Off", "On")),
            "ExposureMode": ("TriggerWidth", ("Timed", "TriggerWidth")),
            "ExposureAuto": ("Continuous", ("Off", "Continuous")),
        },
    )
    made = SfncControls(
        "left", features, SfncOptions(), buffered_frames=3, hardware_timestamp=False
    )
    made.prepare()
    assert (features.texts["SequencerMode"], features.texts["ExposureAuto"]) == ("Off", "Off")
    assert features.texts["ExposureMode"] == "Timed"
    assert len(made.left_on.corrected) == 2


def test_what_its_owner_may_have_chosen_is_told_and_left():
    link = {"DeviceLinkThroughputLimitMode": ("On", ("Off", "On"))}
    limit = {"DeviceLinkThroughputLimit": (25e6, 1e6, 380e6, 1, "Bps")}
    binned = {"BinningHorizontal": (2.0, 1, 4, 1, ""), "OffsetX": (64.0, 0, 600, 16, "")}
    made, features = controls({**OLD_NAMES, **binned, **limit}, {**TRIGGER, **link})
    assert (features.numbers["BinningHorizontal"], features.texts[next(iter(link))]) == (2.0, "On")
    assert not made.left_on.corrected
    said = " ".join(made.notes())
    for words in ("BinningHorizontal is 2.", "OffsetX is 64.", "limited to 25 MB/s"):
        assert words in said


def test_triggers_that_would_hold_frames_back_are_switched_off():
    made, features = controls(OLD_NAMES, TRIGGER)
    triggers = [entry for entry in features.log if entry[0].startswith("Trigger")]
    assert triggers[: triggers.index(("TriggerSelector", "FrameStart"))] == [
        ("TriggerSelector", "AcquisitionStart"),
        ("TriggerMode", "Off"),
    ]
    assert made.read().trigger is TriggerSource.SOFTWARE
    sources = made.capabilities().trigger_sources
    assert sources == (TriggerSource.SOFTWARE, TriggerSource.LINE1, TriggerSource.LINE3, TriggerSource.FREE_RUN)  # fmt: skip


def test_a_camera_without_triggers_runs_freely():
    made, _ = controls(OLD_NAMES, {})
    assert made.capabilities().trigger_sources == (TriggerSource.FREE_RUN,)
    assert made.read() == CameraSettings(5000.0, 0.0, "Mono8", None, TriggerSource.FREE_RUN)


@pytest.mark.parametrize("trigger", [TriggerSource.LINE3, TriggerSource.FREE_RUN])
def test_triggers_are_read_back(trigger):
    made, features = controls(OLD_NAMES, TRIGGER)
    assert made.apply(replace(made.read(), trigger=trigger), made.read()).trigger is trigger
    assert features.texts["TriggerMode"] == ("Off" if trigger is TriggerSource.FREE_RUN else "On")


def test_colour_cameras_are_refused_unless_their_green_channel_is_wanted():
    colour = {"PixelFormat": ("RGB8", ("RGB8", "BayerRG8"))}
    with pytest.raises(UnsupportedFeature, match=r"left: its pixel formats \(RGB8, BayerRG8\)"):
        controls(OLD_NAMES, colour)
    made, _ = controls(OLD_NAMES, colour, colour=True)
    assert made.capabilities().pixel_formats == ("RGB8",)


def test_a_camera_opens_with_the_format_of_the_rig_file():
    made, _ = controls(OLD_NAMES, TRIGGER, pixel_format="Mono12")
    assert made.read().pixel_format == "Mono12"
    with pytest.raises(FeatureError, match="left: PixelFormat Mono9 is not one of Mono8, Mono12"):
        controls(OLD_NAMES, TRIGGER, pixel_format="Mono9")


def test_a_region_is_set_from_the_corner_outwards():
    offsets = {"OffsetX": (64.0, 0, 600, 16, ""), "OffsetY": (8.0, 0, 400, 1, "")}
    _, features = controls({**OLD_NAMES, **offsets}, TRIGGER, region=[32, 10, 320, 200])
    set_numbers = [(name, value) for name, value in features.log if name in (*SIZE, *offsets)]
    assert set_numbers == [
        ("OffsetX", 0), ("OffsetY", 0), ("Width", 320), ("Height", 200), ("OffsetX", 32), ("OffsetY", 10),
    ]  # fmt: skip
    with pytest.raises(FeatureError, match=r"Width 321 of region .* in steps of 16"):
        controls({**OLD_NAMES, **offsets}, TRIGGER, region=[0, 0, 321, 200])


def test_what_a_library_lacks_is_what_the_sentence_installs():
    linked = ImportError("libpython3.11.so.1.0: cannot open shared object file")
    assert _cure(linked, "gentl") == "apt-get install libpython3.11"
    assert (
        _cure(ImportError("No module named 'harvesters'"), "gentl")
        == "pip install 'unglare[gentl]'"
    )
