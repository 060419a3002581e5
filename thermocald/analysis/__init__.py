"""What the calibrated epochs say: statistics, significance, Monte-Carlo, thermal models."""
