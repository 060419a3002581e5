"""The thermal model of a camera: fitted, tested, and used."""
