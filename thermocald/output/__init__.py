"""Reports, figures, exports, printed test fields and the dashboard."""
