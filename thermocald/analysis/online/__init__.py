"""What is known of a camera while it runs."""
