"""Files of loggers and cameras: tables of any dialect, times, photographs."""
