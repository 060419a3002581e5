"""A network of photographs: target coordinates in three dimensions."""
