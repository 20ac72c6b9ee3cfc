"""Why a waypoint is given up."""

from __future__ import annotations

import enum


class GiveUp(enum.IntEnum):
    """Why a waypoint was given up; the first that applies."""

    KEPT = 0
    NO_CROSSING = 1
    FLAT = 2
    NOT_CONVERGED = 3
    WEAK = 4
    AMBIGUOUS = 5
    GLARE = 6
    OUTLIER = 7
    UNSTEADY = 8
    UNCONFIRMED = 9

    @property
    def text(self) -> str:
        """The reason in words."""
        return _REASONS[self]


_REASONS = {
    GiveUp.KEPT: "kept",
    GiveUp.NO_CROSSING: "the intensity does not rise through tau near the coarse surface",
    GiveUp.FLAT: "the intensity does not rise through tau near the coarse surface, where its gradient is too small",
    GiveUp.NOT_CONVERGED: "the refinement did not come close enough to tau",
    GiveUp.WEAK: "the step from air to tissue is much weaker than elsewhere, as in a shadow",
    GiveUp.AMBIGUOUS: "another step, above it or from air again below the first rows, is nearly as strong",
    GiveUp.GLARE: "the air above it is as bright as in a reflection",
    GiveUp.OUTLIER: "it lies off the surface of its neighbours",
    GiveUp.UNSTEADY: "the level set around it is rougher than can be trusted",
    GiveUp.UNCONFIRMED: "it lies beside places that were given up, and a little off its other neighbours",
}
