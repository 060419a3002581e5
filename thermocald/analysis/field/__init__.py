"""What a test field and a camera position can give."""
