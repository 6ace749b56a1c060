"""What a viewer may have left on in a camera, or in the user set that it starts with, and what a scan can't have on.

Such things don't show in a single picture: a tone curve bends fringes, a mirrored picture belongs to no calibration, a
test image is no scene. What is found otherwise is set, read back and told; what stays on and spoils every scan is
refused.
"""

from contextlib import suppress
from dataclasses import dataclass, replace

from backend.devices.drivers.sfnc_features import Features
from backend.devices.errors import FeatureError

Value = str | float | bool


@dataclass(frozen=True)
class _Rule:
    """How a feature has to be, and what goes wrong otherwise."""

    feature: str
    value: Value
    otherwise: str
    needed: bool = False
    """A camera where it can't be set so is refused."""
    or_nearest: bool = False
    """Where the camera can't do this number, the nearest that it can do is as good."""


_SEQUENCER = (_Rule("SequencerMode", "Off", "exposures change from frame to frame", needed=True),)
_RULES = (
    _Rule("ExposureAuto", "Off", "exposures change from frame to frame", needed=True),
    _Rule("GainAuto", "Off", "gains change from frame to frame", needed=True),
    _Rule("TestPattern", "Off", "its pictures are test images", needed=True),
    _Rule("TestImageSelector", "Off", "its pictures are test images", needed=True),
    _Rule("BlackLevelAuto", "Off", "dark pixels change from frame to frame"),
    _Rule("BalanceWhiteAuto", "Off", "colours change from frame to frame"),
    _Rule("GammaEnable", False, "gray levels aren't proportional to light"),
    _Rule("LUTEnable", False, "gray levels aren't proportional to light"),
    _Rule("DigitalShift", 0.0, "gray levels are cut off above"),
    _Rule("SharpnessEnable", False, "edges overshoot"),
    _Rule("SharpeningEnable", False, "edges overshoot"),
    _Rule("ReverseX", False, "pictures are mirrored, which no calibration knows"),
    _Rule("ReverseY", False, "pictures are upside down, which no calibration knows"),
    _Rule("AcquisitionFrameRateEnable", False, "triggers that come faster are passed over"),
    _Rule("AcquisitionFrameRateEnabled", False, "triggers that come faster are passed over"),
)
_OF_A_TRIGGER = (
    # Some cameras can't do less than a few microseconds.
    _Rule("TriggerDelay", 0.0, "it exposes later than it is told to", or_nearest=True),
    _Rule("TriggerDelayAbs", 0.0, "it exposes later than it is told to", or_nearest=True),
)
_TONE_CURVES = (
    # Without a switch of its own. Selectors first: a gamma of 1 counts only where it is the user's that is in force.
    _Rule("GammaSelector", "User", "gray levels aren't proportional to light"),
    _Rule("Gamma", 1.0, "gray levels aren't proportional to light"),
)
_TOLERANCE = 1e-6


@dataclass(frozen=True)
class LeftOn:
    """What was found otherwise."""

    corrected: tuple[str, ...]
    """And set: a sentence each."""
    remaining: tuple[str, ...]
    """And can't be set: a sentence each."""

    def __add__(self, more: "LeftOn") -> "LeftOn":
        """Join what was found in two looks."""
        return LeftOn(self.corrected + more.corrected, self.remaining + more.remaining)


def overrule_sequencer(camera: str, features: Features) -> LeftOn:
    """Do so with the sequencer, before anything else is set: while it runs it locks what it sets, automatics included.

    Raises
    ------
    FeatureError
        If it can't be switched off.
    """
    return _overruled(camera, features, _SEQUENCER)


def overrule(camera: str, features: Features) -> LeftOn:
    """Set what a scan needs otherwise than it is.

    Raises
    ------
    FeatureError
        If something can't be set that spoils every scan.
    """
    return _overruled(camera, features, (*_RULES, *_TONE_CURVES))


def overrule_trigger(camera: str, features: Features) -> LeftOn:
    """Do the same with the trigger that is selected."""
    return _overruled(camera, features, _OF_A_TRIGGER)


def _overruled(camera: str, features: Features, rules: tuple[_Rule, ...]) -> LeftOn:
    corrected: list[str] = []
    remaining: list[str] = []
    for rule in (_reachable(features, rule) for rule in rules):
        if (
            rule in _TONE_CURVES
            and features.has("GammaEnable")
            and not features.flag("GammaEnable")
        ):
            continue  # switched off altogether
        found = _found(features, rule)
        if found is None or _agrees(found, rule.value):
            continue
        now, why = _set(features, rule)
        if _agrees(now, rule.value):
            corrected.append(
                f"{camera}: {rule.feature} was {_word(found)} and is {_word(now)} now ({rule.otherwise} else)."
            )
            continue
        problem = (
            f"{rule.feature} is {_word(now)} and can't be set to {_word(rule.value)}{why}: {rule.otherwise}; set it in the"
            " vendor's viewer, or load the camera's default user set"
        )
        if rule.needed:
            raise FeatureError(camera, problem)
        remaining.append(f"{camera}: {problem}.")
    return LeftOn(tuple(corrected), tuple(remaining))


def _reachable(features: Features, rule: _Rule) -> _Rule:
    """Return a rule as far as the camera can follow it, where that is enough."""
    if not (rule.or_nearest and isinstance(rule.value, float) and features.has(rule.feature)):
        return rule
    low, high, _ = features.bounds(rule.feature)
    return replace(rule, value=min(max(rule.value, low), high))


def _found(features: Features, rule: _Rule) -> Value | None:
    """Return how a feature is; None where the camera hasn't it, or it can be nothing else."""
    if not features.has(rule.feature):
        return None
    if isinstance(rule.value, str) and rule.value not in features.choices(rule.feature):
        now = features.text(rule.feature)
        # An automatic that can't be switched off is a fault; a choice that this camera calls otherwise isn't.
        return now if rule.needed and now != rule.value else None
    return _read(features, rule)


def _read(features: Features, rule: _Rule) -> Value:
    if isinstance(rule.value, bool):
        return features.flag(rule.feature)
    if isinstance(rule.value, str):
        return features.text(rule.feature)
    return features.number(rule.feature)


def _set(features: Features, rule: _Rule) -> tuple[Value, str]:
    """Set a feature; return what is read back, and why it is refused."""
    why = ""
    try:
        if isinstance(rule.value, bool):
            features.set_flag(rule.feature, value=rule.value)
        elif isinstance(rule.value, str):
            features.set_text(rule.feature, rule.value)
        else:
            features.set_number(rule.feature, rule.value)
    except Exception as error:  # noqa: BLE001  each library has its own; the sentence says what it said
        why = f" ({' '.join(str(error).split())})"
    return _read(features, rule), why


def _agrees(now: Value, wanted: Value) -> bool:
    if isinstance(now, str) or isinstance(wanted, str):
        return now == wanted
    return abs(now - wanted) <= _TOLERANCE


def _word(value: Value) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    return value if isinstance(value, str) else f"{value:g}"


_WORTH_TELLING = (
    ("BinningHorizontal", 1.0), ("BinningVertical", 1.0), ("DecimationHorizontal", 1.0), ("DecimationVertical", 1.0),
    ("OffsetX", 0.0), ("OffsetY", 0.0), ("BlackLevel", 0.0),
)  # fmt: skip


def told(camera: str, features: Features) -> tuple[str, ...]:
    """Say what its owner may have chosen on purpose, and should know of: a part of the sensor, a limited link."""
    said: list[str] = []
    with suppress(Exception):  # only for information: one that can't be read isn't told
        for name, usual in _WORTH_TELLING:
            if features.has(name) and features.number(name) != usual:
                said.append(f"{camera}: {name} is {features.number(name):g}.")
        if features.has("DeviceLinkThroughputLimit") and _is_limited(features):
            rate_mb = features.number("DeviceLinkThroughputLimit") / 1e6
            said.append(
                f"{camera}: its link is limited to {rate_mb:g} MB/s (DeviceLinkThroughputLimit); raise it where frames"
                " come slowly."
            )
    return tuple(said)


def _is_limited(features: Features) -> bool:
    mode = "DeviceLinkThroughputLimitMode"
    return not features.has(mode) or features.text(mode) == "On"
