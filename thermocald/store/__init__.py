"""Recordings, stores in files and on servers, and logs of other programs."""
