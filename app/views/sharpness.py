"""How sharp a picture is, as a share of the best since the focus ring was first touched."""

import numpy as np

from app import markup

_IN_A_ROW = 3
_GOOD, _FAIR = 0.95, 0.7
_MUCH_SATURATED_SHARE = 0.02


class SharpnessAid:
    """The focus aid of one camera, or of a part of its picture.

    Of three pictures in a row the middle one counts, so that no single one does.
    """

    def __init__(self) -> None:
        self._lately: dict[int, float] = {}
        """Sharpness by the number of the picture."""
        self._best = 0.0
        self._is_too_bright = False

    def note(self, number: int, sharpness: float, saturated_share: float = 0.0) -> None:
        """Take the next picture into account; one that is known already changes nothing.

        Where much of it is saturated it has edges that the scene hasn't: then it is left out.
        """
        self._is_too_bright = saturated_share > _MUCH_SATURATED_SHARE
        if self._is_too_bright:
            self._lately.clear()
            return
        self._lately[number] = sharpness
        for old in sorted(self._lately)[:-_IN_A_ROW]:
            del self._lately[old]
        if len(self._lately) == _IN_A_ROW:
            self._best = max(self._best, self._now)

    def forget_best(self) -> None:
        """Begin anew: what comes next is the best."""
        self._lately, self._best = {}, 0.0

    @property
    def share(self) -> float | None:
        """Of the best, in [0, 1]; None as long as there are too few pictures, or nothing to be sharp."""
        return max(0.0, self._now / self._best) if self._best > 0 and self._lately else None

    @property
    def _now(self) -> float:
        return float(np.median(list(self._lately.values())))

    @property
    def _why_none(self) -> str:
        return "too bright to tell" if self._is_too_bright else "looking …"

    def html(self) -> str:
        """Return it as a bar and in words."""
        share = self.share
        width = share or 0.0
        words = f"{100 * width:.0f} % of best" if share is not None else self._why_none
        colour = "#3fae6a" if width >= _GOOD else "#e8a33d" if width >= _FAIR else "#e25555"
        bar = f'<div class="ug-progress"><div style="width:{100 * width:.0f}%;background:{colour}"></div></div>'
        return markup.div(
            "ug-sharp", markup.span("", "sharpness") + bar + markup.span("ug-value", words)
        )
