"""Targets in an image: detected, identified by their codes, and measured."""
