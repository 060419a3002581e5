"""The camera: its model, and the models of other programs."""
