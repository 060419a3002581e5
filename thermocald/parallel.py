"""Independent tasks in several processes, with the same results as in one.

The results come in the order of the items and are combined by the caller. Sums are therefore formed
in the same order for any number of processes, and every bit is the same.
"""

from __future__ import annotations

import pickle
from collections import deque
from typing import TYPE_CHECKING, Any, TypeVar

from thermocald.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from concurrent.futures import Future, ProcessPoolExecutor

    State = TypeVar("State")
    Item = TypeVar("Item")
    Result = TypeVar("Result")


_WAITING = 2  # items per process handed out ahead; they are held in memory

_current: tuple[Any, Any] | None = None  # in a process of the pool: its function and state


def in_order(
    work: Callable[[State, Item], Result], state: State, items: Iterable[Item], jobs: int = 1
) -> Iterator[Result]:
    """Yield the results of `work(state, item)` for all items, in their order.

    work: a module's function; state: further input, passed to each process once; items: taken a few
    ahead of the results; jobs: number of processes, 1: this one. An exception of `work` is raised
    here. Raises DataError if a process ends unexpectedly.
    """
    if jobs <= 1:
        # pickled as for a process: an array's order in memory decides how sums are rounded
        state = pickle.loads(pickle.dumps(state))
        for item in items:
            yield work(state, item)
        return
    from concurrent.futures.process import BrokenProcessPool

    with processes(jobs, _begin, (work, state)) as pool:
        waiting: deque[Future[Any]] = deque()
        try:
            for item in items:
                waiting.append(pool.submit(_work_on, item))
                if len(waiting) >= _WAITING * jobs:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        except BrokenProcessPool as cause:
            raise DataError(
                f"one of {jobs} processes ended unexpectedly, perhaps for lack of memory; give "
                "fewer --jobs"
            ) from cause
        finally:
            for future in waiting:
                future.cancel()


def processes(
    jobs: int, begin: Callable[..., None] | None = None, given: tuple[Any, ...] = ()
) -> ProcessPoolExecutor:
    """Return a pool of new processes, each of which begins with `begin(*given)`.

    They are not forked: the threads of OpenCV and of linear algebra do not survive a fork.
    """
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context  # 1 MB that a daemon does without

    return ProcessPoolExecutor(jobs, get_context("spawn"), begin, given)


def _begin(work: Any, state: Any) -> None:
    global _current  # a process of a pool has one task
    _current = work, state


def _work_on(item: Any) -> Any:
    assert _current is not None  # set when the process began
    work, state = _current
    return work(state, item)
