"""Discovery: where simulation and measurement disagree, and the name of the missing effect.

`evidence` says what a recording shows before any search, `examination` searches the catalogue
(`search`, and `mounted` where the camera moves) and asks for proof (`validation`), `proposal` goes
beyond it with `formulas`; `result` is names, numbers with standard deviations and gaps, `model` the
next version of the thermal model. `criteria` are the numbers that decide.
"""

from __future__ import annotations
