"""The dashboard for Grafana: valid JSON, and all its SQL runs on the schema."""

from __future__ import annotations

import json
import re
import time
from dataclasses import replace

import pytest

pytest.importorskip("psycopg", reason="pip install thermocald[server]")
import psycopg

from benchmarks.generated_fleet import STORE, GeneratedCamera, add_camera
from tests.commands import succeed
from thermocald.store.server.connection import ServerAddress, grant
from thermocald.store.server.reader import ServerWriter

# the values with which Grafana's PostgreSQL source replaces its macros and variables
MACROS = {
    "$__unixEpochFrom()": "{first}", "$__unixEpochTo()": "{last}", "$__interval_ms": "60000",
    "${station:sqlstring}": "'bank','hill'",
}  # fmt: skip


@pytest.fixture(scope="module")
def dashboard():
    return json.loads(succeed("server", "dashboard").stdout)


def queries(dashboard):
    for panel in dashboard["panels"]:
        for target in panel["targets"]:
            yield panel["title"], target["rawSql"]


def test_it_is_what_grafana_imports(dashboard):
    assert dashboard["schemaVersion"] >= 39
    ids = [panel["id"] for panel in dashboard["panels"]]
    assert len({*ids}) == len(ids)
    source = {"type": "grafana-postgresql-datasource", "uid": "${datasource}"}
    for panel in dashboard["panels"]:
        assert panel["datasource"] == source
        assert {"x", "y", "w", "h"} == {*panel["gridPos"]}
        assert panel["gridPos"]["x"] + panel["gridPos"]["w"] <= 24
    names = [variable["name"] for variable in dashboard["templating"]["list"]]
    used = {v for _, sql in queries(dashboard) for v in re.findall(r"\$\{(\w+)", sql)}
    assert used | {"datasource"} == {*names}


def test_every_query_runs_and_finds_something(server, dashboard):
    now = time.time()
    camera = GeneratedCamera("bank", epochs=200, end=now - 1000)
    with psycopg.connect(server.address(name="thermocald")) as connection:
        for station in ("bank", "hill"):
            add_camera(connection, replace(camera, station=station))
        connection.execute(
            "INSERT INTO event VALUES ('bank', 1, %s, 'knock', 'x', NULL, 1, '{}')", (now - 1100,)
        )
        connection.execute("CREATE ROLE grafana LOGIN PASSWORD 'g'")
    address = ServerAddress.parse(server.address(name="thermocald"))
    grant(address, "grafana", writes=False)
    with ServerWriter(address, "bank", STORE) as writer:
        writer.report(0, 0, now)
    values = {"first": str(now - 7200), "last": str(now)}
    try:
        reader = server.address(user="grafana:g", name="thermocald")
        with psycopg.connect(reader) as connection:
            (query,) = (v["query"] for v in dashboard["templating"]["list"] if v["type"] == "query")
            assert connection.execute(query).fetchall() == [("bank",), ("hill",)]
            for title, sql in queries(dashboard):
                for macro, value in MACROS.items():
                    sql = sql.replace(macro, value.format(**values))
                assert "$" not in sql, title
                cursor = connection.execute(sql)
                rows = cursor.fetchall()
                assert rows, title
                if '"time"' in sql and "kind" not in sql:
                    assert [c.name for c in cursor.description] == ["time", "metric", "value"]
            late = next(sql for title, sql in queries(dashboard) if "15 minutes" in title)
            late = late.replace("${station:sqlstring}", "'bank','hill'")
            assert connection.execute(late).fetchone() == (2,)
    finally:
        with psycopg.connect(server.address(name="thermocald"), autocommit=True) as connection:
            connection.execute("DROP OWNED BY grafana")
            connection.execute("DROP ROLE grafana")
