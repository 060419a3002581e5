"""The dashboard for Grafana: valid JSON, and all its SQL runs on the schema."""

from __future__ import annotations

import json
import re
import time
from dataclasses import replace

import pytest

pytest.importorskip("psycopg", reason="pip install thermocald[server]")
import psycopg
from psycopg.rows import dict_row

from benchmarks.generated_fleet import STORE, GeneratedCamera, add_camera
from tests.commands import succeed
from tests.fleet.conftest import address, execute
from thermocald.store.server.connection import grant
from thermocald.store.server.reader import ServerWriter

# the values with which Grafana's PostgreSQL source replaces its macros and variables
MACROS = {"$__interval_ms": "60000", "${station:sqlstring}": "'bank','hill'"}


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
    """As a role that may only read."""
    now = time.time()
    camera = GeneratedCamera("bank", epochs=200, end=now - 1000)
    with psycopg.connect(server.address(name="thermocald")) as connection:
        for station in ("bank", "hill"):
            add_camera(connection, replace(camera, station=station))
    knock = "INSERT INTO event VALUES ('bank', 1, %s, 'knock', 'x', NULL, 1, '{}')"
    execute(server, knock, now - 1100)
    execute(server, "CREATE ROLE grafana LOGIN PASSWORD 'g'")
    grant(address(server), "grafana", writes=False)
    with ServerWriter(address(server), "bank", STORE) as writer:
        writer.report(0, 0, now)
    (query,) = (v["query"] for v in dashboard["templating"]["list"] if v["type"] == "query")
    macros = MACROS | {"$__unixEpochFrom()": str(now - 7200), "$__unixEpochTo()": str(now)}
    try:
        with psycopg.connect(
            server.address(user="grafana:g", name="thermocald"), row_factory=dict_row
        ) as connection:
            stations = [list(row.values()) for row in connection.execute(query)]
            assert stations == [["bank"], ["hill"]]
            for title, sql in queries(dashboard):
                for macro, value in macros.items():
                    sql = sql.replace(macro, value)
                assert "$" not in sql, title
                rows = connection.execute(sql).fetchall()
                assert rows, title
                if '"time"' in sql and "kind" not in sql:
                    assert [*rows[0]] == ["time", "metric", "value"]
                if "15 minutes" in title:
                    assert [*rows[0].values()] == [2]
    finally:
        execute(server, "DROP OWNED BY grafana; DROP ROLE grafana")
