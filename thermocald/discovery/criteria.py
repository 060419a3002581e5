"""The numbers that decide a verdict, and the origin of each.

A difference d of scores or of -2 log L is a likelihood ratio of exp(d / 2). "Scored" means that no
distribution gives the number: with it, causes are named without false alarms in recordings whose
truth is known (`tests/blind`, `tests/real_corners`; docs/reference/discovery-confusion.md).
"""

from __future__ import annotations

# -- targets that moved ------------------------------------------------------------------------

STEP_CHI2 = 60.0  # χ² with 2 degrees of freedom, for 147 targets × 180 times: one in 10⁸
STEP_PX = 0.02  # half the usual noise of a point; a smaller step moves no camera
STEP_SHARE = 0.9  # share of a target's slow movement that a step explains; else it wanders. Scored

# -- the search --------------------------------------------------------------------------------

MARGIN = 16.0  # added to the penalty of a search, for errors of the noise model itself. Scored
EPOCHS_EACH = 15  # least number per effect: in fewer, effects imitate a camera that walks. Scored
NO_WALK_EACH = 50  # number of epochs per effect from which on no walk was named. Scored
SET_SHARE = 0.95  # share of its best set's promise at which another set of parameters is fitted
BAND = 14.0  # a solution with a score worse by less is not excluded: odds of 1 to 1,100
DRIVES_BAND = 120.0  # the same in χ², for one drive in place of another. Scored
LEFT_SHARE = 0.03  # share of the base model's misfit; a model that leaves less is adequate. Scored
LEFT_PX = 0.025  # a third of the noise; a larger misfit shows, whatever the base model left. Scored
LEFT_SIGMAS = 3.0  # sd of a misfit left by two effects, above which a thermometer's lag is tried
FURTHER_PX = 0.005  # least size of an effect beside an adequate model: an eighth of the noise
FURTHER_SHARE = 0.15  # the same, as a share of the first effect; less refines that one. Scored
CURVATURE_PX = 0.001  # accuracy of the projection's curvature where the image moves by 10 px

# -- a mount that moves ------------------------------------------------------------------------

MEMORY = 1.9  # variance of slow trajectories over white noise, above it a mount moves. Scored
SMOOTH = 30.0  # power in the slowest half-waves over a random walk's; above it, no mount. Scored
WANDERING = 3.0  # variance as for MEMORY, above which one series alone names no effect. Scored
SLIP_NOT_KNOCK = 20.0  # χ² by which an internal slip must fit better than a knock: 1 to 22,000
MOUNT_FURTHER = 40.0  # least gain of a further effect: a mount is no exact random walk. Scored
MOUNT_SHARE = 0.25  # the same, as a share of the first effect's gain. Scored
MOUNT_WORSE = 0.25  # share of its gain in one series by which an effect may worsen another. Scored
# sd by which a movement exceeds what the exterior orientation explains, in too few epochs for
# SMOOTH: -2 in real corners, 97 and more where the camera's interior moved by 0.3 px. Scored
INTERIOR = 60.0
# the same where only an effect may be a random walk: -1 to 7 in walks, 25 and more where a lag or
# |dT/dt| of 0.1 px was left to the mount. Scored
INTERIOR_OF_WALK = 20.0

# -- validation --------------------------------------------------------------------------------

BLOCK_WORSE = 10.0  # -2 log L by which a cause may worsen a block left out: odds of 1 to 150
BLOCK_WORSE_SHARE = 0.02  # added share of its whole gain, for errors of the noise model
FALSE_ALARM = 0.01  # probability of a false name from which an effect is not named: the goal
SURROGATES = 119  # so many that a single one that reaches an effect makes 2/120 > FALSE_ALARM

# -- formulas ----------------------------------------------------------------------------------

FORMULA_SURROGATES = 199
FORMULA_BAND = 16.0  # a formula with a score worse by less is not excluded: one MARGIN
PARAMETER_SHARE = 0.01  # share of the misfit that one more parameter of a formula must explain
# share of one recording's misfit that constants of the other alone explain: of M2 by M1's, of M1
# by M2's (which may be less certain), and of M2 by M1's if M2 does not determine them. Scored
CLOSED, CLOSED_BACK, CLOSED_ALONE = 0.8, 0.5, 0.95

# -- statements --------------------------------------------------------------------------------

SHIFT_OR_TILT = 18.5  # quantile 0.999 of χ² with the four coefficients of shift and tilt
NAMED_SHARE = 0.95  # share of an unnamed movement that the named parameters must explain
NAMED_WORTH = 0.02  # share of it that one more of them must add
