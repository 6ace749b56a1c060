"""What numerics refuses: each message is the thing, the value, the way out, in one sentence."""


class NumericsError(ValueError):
    """An input that the mathematics can't use; stages translate it for the operator."""


class FrameError(NumericsError):
    """Frames don't belong together: number, size, type or exposure."""


class PatternError(NumericsError):
    """A pattern can't be rendered: unknown axis, gray levels out of range, no period."""


class FrequencyError(NumericsError):
    """Steps or frequencies don't determine a coordinate over the whole width of the code."""


class CodeError(NumericsError):
    """A Gray code doesn't fit: too few bits for its codes, or no bit left to read."""


class HistogramError(NumericsError):
    """The histogram can't be split: no foreground, or one gray level only."""


class ZoneError(NumericsError):
    """Given valleys don't make zones: not increasing, or a zone without pixels."""


class PlanningError(NumericsError):
    """No set of exposures satisfies the budget, the camera's range or the pixels given."""


class CalibrationError(NumericsError):
    """A camera model or a pose is singular, not finite, or doesn't fit the picture."""


class MatchingError(NumericsError):
    """Two coordinate maps can't be matched: sizes differ, or nothing in them is valid."""


class ResponseError(NumericsError):
    """A response can't be determined: one exposure, nothing but clipped samples, a ramp that isn't monotone."""


class ScreenError(NumericsError):
    """The shape of a screen can't be used: too few points, not finite, or all on one line."""


class MirrorError(NumericsError):
    """A mirror's pose or surface can't be found: no outline, too few markers, or rays that miss it."""
