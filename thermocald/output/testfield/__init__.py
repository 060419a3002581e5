"""The layout, drawing and printing of test fields."""
