"""What a recording shows before any search: targets that moved, noise that grows."""
