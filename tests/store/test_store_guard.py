"""The guard of a store whose disk has space for an event but not for a row."""

from __future__ import annotations

from thermocald.daemon.store_guard import Row, StoreGuard


def test_a_row_that_found_no_room_waits(tmp_path, head, field, make_epoch, make_result):
    """Regression: an event still fitted into its page, so the row was taken for a bad one."""
    guard = StoreGuard(tmp_path / "t.db", durable=False)
    series = guard.store.create_series(head, field)

    def keep(number):
        guard.append(Row(series, make_epoch(number), make_result(number), {}, True))

    keep(1)
    connection = guard.store._db
    (pages,) = connection.execute("PRAGMA page_count").fetchone()
    connection.execute(f"PRAGMA max_page_count = {pages}")
    number = 1
    while not guard.waiting and number < 1000:  # until the last page is full
        number += 1
        keep(number)
    keep(number + 1)
    assert "disk is full" in guard.away
    assert (guard.lost, guard.waiting) == (0, 2)
    connection.execute("PRAGMA max_page_count = 1000000")
    guard.flush()
    assert (guard.away, guard.lost, guard.waiting) == ("", 0, 0)
    stored = [epoch.epoch.number for epoch in guard.store.epochs(series)]
    assert stored == list(range(1, number + 2))
    guard.close()
