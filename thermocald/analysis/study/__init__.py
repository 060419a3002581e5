"""The study of one or several cameras, after Elias et al. 2020."""
