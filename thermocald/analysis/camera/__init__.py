"""One camera at one time: calibrated, undistorted, corrected."""
