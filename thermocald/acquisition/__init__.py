"""Acquisition: from devices to epochs, and from epochs to calibrated ones."""
