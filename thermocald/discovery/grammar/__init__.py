"""Beyond the catalogue: formulas over what was recorded, searched as its effects are."""
