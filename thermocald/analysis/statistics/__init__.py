"""Statistics of time series: correlation, lines, significance."""
