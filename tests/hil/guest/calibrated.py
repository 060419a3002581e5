"""Print {status: number of epochs} of the camera `river`, without the program."""

import json
import sqlite3

# a later calibration of an epoch is a row with a higher revision
QUERY = """SELECT status, count(*) FROM (
               SELECT status, max(revision) FROM epoch JOIN series s ON s.id = series_id
               WHERE camera = 'river' GROUP BY number)
           GROUP BY status"""
path = "file:/var/lib/thermocald/store/thermocald.db?mode=ro"
print(json.dumps(dict(sqlite3.connect(path, uri=True).execute(QUERY).fetchall())))
