"""The numbers that decide a verdict, and where each comes from.

A difference d of scores or of -2 log L is a likelihood ratio of exp(d / 2). "Scored" says that no
distribution gives the number: it is what names causes and raises no false alarm on recordings whose
truth is known (`tests/blind`, `tests/real_corners`; docs/reference/discovery-confusion.md).
"""

from __future__ import annotations

# -- targets that moved ------------------------------------------------------------------------

STEP_CHI2 = 60.0  # of χ² with 2 degrees of freedom, over 147 targets × 180 times: one in 10⁸
STEP_PX = 0.02  # half the usual noise of a point: what is smaller moves no camera
STEP_SHARE = 0.9  # of a target's slow movement that a step explains; else it wanders. Scored

# -- the search --------------------------------------------------------------------------------

MARGIN = 16.0  # beyond the penalty of a search, for errors of the noise model itself. Scored
SET_SHARE = 0.95  # of its best set's promise that another set of parameters needs to be fitted
BAND = 14.0  # score by which a solution is worse and not excluded: odds of 1 to 1,100
DRIVES_BAND = 120.0  # χ² for one way of following the temperature in place of another. Scored
LEFT_SHARE = 0.03  # of what the base leaves; a model that leaves less has the cause. Scored
FURTHER_PX = 0.005  # that an effect explains beside one that leaves nothing: an eighth of the noise
FURTHER_SHARE = 0.15  # of what the first explains; less is the first one's finer points. Scored
CURVATURE_PX = 0.001  # to which the projection's curvature is known where the image moves by 10 px

# -- a mount that moves ------------------------------------------------------------------------

MEMORY = (
    1.9  # variance of slow trajectories over white noise above which a mount is assumed. Scored
)
SMOOTH = 30.0  # times the power of a random walk in the slowest half-waves: no mount. Scored
WANDERING = 3.0  # the same variance, above which one series alone carries no name. Scored
SLIP_NOT_KNOCK = 20.0  # χ² by which a slip inside has to fit better than a knock: 1 to 22,000
MOUNT_FURTHER = 40.0  # of each further effect: a mount is not quite a random walk. Scored
MOUNT_SHARE = 0.25  # of what the first effect gains that a further one has to gain. Scored
MOUNT_WORSE = 0.25  # of its gain in one series by which an effect may worsen another. Scored

# -- validation --------------------------------------------------------------------------------

BLOCK_WORSE = 10.0  # -2 log L by which a cause may worsen a block left out: odds of 1 to 150
BLOCK_WORSE_SHARE = 0.02  # and as a share of all that it explains: what the noise model misses
FALSE_ALARM = 0.01  # probability of a false name at which an effect is no longer named: the goal
SURROGATES = 119  # of which one alone that reaches an effect makes 2/120 > FALSE_ALARM

# -- formulas ----------------------------------------------------------------------------------

FORMULA_SURROGATES = 199
FORMULA_BAND = 16.0  # score by which a formula is worse and not excluded: one MARGIN
PARAMETER_SHARE = 0.01  # of the misfit that one more parameter of a formula has to explain
# shares of the misfit that constants of one recording alone explain on the other: M1 on M2, M2 on
# M1 (which may hold less), and M1 on M2 where M2 does not determine them. Scored
CLOSED, CLOSED_BACK, CLOSED_ALONE = 0.8, 0.5, 0.95

# -- words -------------------------------------------------------------------------------------

SHIFT_OR_TILT = 18.5  # quantile 0.999 of χ² with the four coefficients of shift and tilt
LOOSE = 0.5  # share of a time constant that its sd exceeds where it is not determined: 2 sd
NAMED_SHARE = 0.95  # of an unnamed movement that the parameters said have to make
NAMED_WORTH = 0.02  # of it that one more of them has to add
EXCESS = 0.02  # of reduced χ²: a smaller excess is its own scatter and cannot be closed
