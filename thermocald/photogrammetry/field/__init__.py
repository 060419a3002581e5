"""The test field: targets, their planes, and observations by target name."""
