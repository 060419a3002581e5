"""The verdict: names, numbers with standard deviations, gaps, the new model."""
