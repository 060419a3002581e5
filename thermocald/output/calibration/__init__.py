"""The report of a calibration from photographs."""
