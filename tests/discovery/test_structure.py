"""The layers of discovery: imports go one way and through few floors."""

from __future__ import annotations

from functools import cache

import grimp


def test_eight_floors_at_most_and_no_circle():
    graph = grimp.build_graph("thermocald", cache_dir=None)
    modules = {m for m in graph.modules if m.startswith("thermocald.discovery.")}

    @cache
    def floors(module: str, above: tuple[str, ...] = ()) -> int:
        assert module not in above, f"a circle: {' -> '.join((*above, module))}"
        below = graph.find_modules_directly_imported_by(module) & modules
        return 1 + max((floors(m, (*above, module)) for m in below), default=0)

    deepest = max(modules, key=floors)
    assert floors(deepest) <= 8, deepest
