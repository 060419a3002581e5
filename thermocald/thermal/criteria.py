"""The numbers that decide about noise and gross errors of a series, and where each comes from.

"Scored" as in `discovery.criteria`.
"""

from __future__ import annotations

# -- what a series has to hold -----------------------------------------------------------------

MIN_EPOCHS = 20  # with a result: six blocks left out hold three epochs each
LEAST_EPOCHS = 3  # for a fit of known effects
MIN_TARGETS = 12  # for 19 unknowns and five redundant coordinates
MIN_DURATION = 120.0  # s: heat needs minutes to reach a camera
LEAST_CHANGE_K = 1.0  # of the temperature, and LEAST_CHANGE times its noise
LEAST_CHANGE = 8.0

# -- gross errors ------------------------------------------------------------------------------

GROSS = 4.5  # sd of a residual against its neighbours in time: 7 in 10⁶ by chance
SPIKE = 7.0  # the same before any adjustment, where the neighbours' median is all there is
GROSS_OF_MEAN = 6.0  # sd from the median of a short mean
LEAP = 10.0  # times the usual squared deviation of an epoch from its neighbours

# -- noise -------------------------------------------------------------------------------------

GROWTH = 40.0  # -2 log L by which a noise that follows the temperature beats a constant one. Scored
CLEAR = 10.0  # -2 log L by which one trajectory of the noise excludes another: odds of 1 to 150
UNUSUAL = 1.7  # times a variance known to 13 %, from 170 second differences: five sd
BEYOND = 1.15  # times the largest eigenvalue that noise shows (Marchenko, Pastur). Scored
FEWEST = 60  # epochs that tell how much a series jumps: its variance to 25 %

# -- the absolute test -------------------------------------------------------------------------

SIGNIFICANT = 6.0  # sd by which the rest of a model must be surpassed to count
NEGLIGIBLE_PX = 0.004  # a smooth misfit below this is not worth a name: a tenth of a point's noise
