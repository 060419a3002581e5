"""What people's loggers and cameras write: tables of any dialect, clocks, photographs."""
