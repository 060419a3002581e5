"""Figures as SVG: panels, marks, and numbers."""
