"""Independent pieces of work on several processes, with the same results as on one.

The results come in the order of the items and are put together by who asked for them, so that sums
are added in one order whatever the number of processes: every bit is the same.
"""

from __future__ import annotations

import pickle
from collections import deque
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from typing import TYPE_CHECKING, Any, TypeVar

from thermocald.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    State = TypeVar("State")
    Item = TypeVar("Item")
    Result = TypeVar("Result")


_WAITING = 2  # items a process that are handed out ahead: what they hold is in memory

_current: tuple[Any, Any] | None = None  # of a process of the pool: its function and its state


def in_order(
    work: Callable[[State, Item], Result], state: State, items: Iterable[Item], jobs: int = 1
) -> Iterator[Result]:
    """Yield the results of `work(state, item)` for all items, in their order.

    work: a function of a module; state: what it needs besides the item, handed to each process
    once; items: taken as results are asked for, a few ahead; jobs: how many processes, 1: this one.
    An exception of `work` is raised here. Raises DataError where a process ends by itself.
    """
    if jobs <= 1:
        # as a process gets it: in which order an array lies in memory decides how sums are rounded
        state = pickle.loads(pickle.dumps(state))
        for item in items:
            yield work(state, item)
        return
    with processes(jobs, _begin, (work, state)) as pool:
        waiting: deque[Future[Any]] = deque()
        try:
            for item in items:
                waiting.append(pool.submit(_done, item))
                if len(waiting) >= _WAITING * jobs:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        except BrokenProcessPool as cause:
            raise DataError(
                f"one of {jobs} processes ended by itself, for want of memory perhaps: "
                "take fewer --jobs"
            ) from cause
        finally:
            for future in waiting:
                future.cancel()


def processes(
    jobs: int, begin: Callable[..., None] | None = None, given: tuple[Any, ...] = ()
) -> ProcessPoolExecutor:
    """Make a pool of fresh processes, each of which begins with `begin(*given)`.

    Not forked: the threads of OpenCV and of linear algebra do not survive that.
    """
    return ProcessPoolExecutor(jobs, get_context("spawn"), begin, given)


def _begin(work: Any, state: Any) -> None:
    global _current  # a process of a pool has one task
    _current = work, state


def _done(item: Any) -> Any:
    assert _current is not None  # set as the process began
    work, state = _current
    return work(state, item)
