"""Discovery: where simulation and measurement disagree, and the name of the missing effect.

`evidence` finds moved targets before any search. `examination` searches the catalogue (`search`, or
`mounted` if the camera moves on its mount) and validates the effects found (`validation`);
`proposal` searches beyond the catalogue with `formulas`. `result` holds names, numbers with
standard deviations, gaps and the next version of the thermal model. `criteria` holds the numbers
that decide.
"""

from __future__ import annotations
