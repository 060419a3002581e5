"""The simulation: bodies that warm, effects on the camera, observations and rendered frames."""
