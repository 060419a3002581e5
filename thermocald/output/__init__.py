"""What users take home: reports, figures, exports, the dashboard."""
