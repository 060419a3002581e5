"""Recordings and the store."""
