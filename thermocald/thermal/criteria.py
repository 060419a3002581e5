"""The limits for a series' extent, noise and gross errors, with the reason for each.

"Scored" has the meaning that it has in `discovery.criteria`.
"""

from __future__ import annotations

# -- what a series must contain ----------------------------------------------------------------

MIN_EPOCHS = 20  # with a result: each of six blocks, left out in turn, has three epochs
LEAST_EPOCHS = 3  # for a fit of known effects
MIN_TARGETS = 12  # for 19 unknowns and five redundant coordinates
MIN_DURATION = 120.0  # s: heat needs minutes to reach a camera
LEAST_CHANGE_K = 1.0  # of the temperature; also at least LEAST_CHANGE times its noise
LEAST_CHANGE = 8.0

# -- gross errors ------------------------------------------------------------------------------

GROSS = 4.5  # sd of a residual from its neighbours in time: 7 in 10⁶ by chance
SPIKE = 7.0  # the same before any adjustment, relative to the neighbours' median
GROSS_OF_MEAN = 6.0  # sd from the median of the epochs of a short mean
BRIEF, TOUCH = 3, 2.0  # epochs of a touch; times the changes around it, which heat exceeds by 1.2
SELDOM = 0.05  # share of the epochs that may be touched
LEAP = 10.0  # times the usual squared deviation of an epoch from its neighbours

# -- noise -------------------------------------------------------------------------------------

GROWTH = 40.0  # least gain in -2 log L of noise that follows the temperature. Scored
CLEAR = 10.0  # -2 log L by which one trajectory of the noise excludes another: odds of 1 to 150
UNUSUAL = 1.7  # times a variance known to 13 %, from 170 second differences: five sd
BEYOND = 1.15  # times the largest eigenvalue due to noise (Marchenko, Pastur). Scored
KINKED = 100.0  # power of fast half-waves over that of jumps; a random walk has 2 to 10. Scored
FEWEST = 60  # epochs for an estimate of a series' jumps: of their variance, to 25 %

# -- the absolute test -------------------------------------------------------------------------

SIGNIFICANT = 6.0  # sd by which a model's misfit must exceed its expectation
NEGLIGIBLE_PX = 0.004  # RMS of a smooth misfit that does not matter: a tenth of a point's noise
