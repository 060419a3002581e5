"""Test fields laid out, drawn, and printed."""
