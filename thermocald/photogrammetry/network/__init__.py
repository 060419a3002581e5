"""Adjustment of photographs together: a free network, or known targets and one camera."""
