"""How many epochs of the camera `river` have a calibration: a quick look without the program."""

import json
import sqlite3

QUERY = """SELECT count(DISTINCT number) FROM epoch JOIN series s ON s.id = series_id
           WHERE camera = 'river' AND status = 'ok'"""
path = "file:/var/lib/thermocald/thermocald.db?mode=ro"
print(json.dumps(sqlite3.connect(path, uri=True).execute(QUERY).fetchone()[0]))
