"""Series reduced to small normal equations, and the hypotheses that are fitted to them."""
