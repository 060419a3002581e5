"""Analysis of calibrated epochs: statistics, significance, Monte-Carlo, thermal models."""
