"""What is many times independent, on the cores of this machine or on a Dask cluster.

One function and many items; every engine calls the same function with the same items, so that the
results are the same to the last bit. An item whose process dies is tried again; what kills its
process every time costs itself and nothing else.
"""

from __future__ import annotations

from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from importlib import import_module
from typing import TYPE_CHECKING, Any, TypeVar

from thermocald.errors import ServerGone, UsageError
from thermocald.parallel import processes

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    Item = TypeVar("Item")
    Result = TypeVar("Result")


_ROUNDS = 3
"""How often an item is handed to a cluster whose workers died of it, or of something else."""


def run_tasks(
    work: Callable[[Item], Result],
    items: Sequence[Item],
    lost: Callable[[Item, str], Result],
    engine: str = "local",
    jobs: int = 1,
) -> Iterator[Result]:
    """The results of `work` for all items, in the order in which they are done.

    work: a function of a module, which raises nothing; lost: the result of an item whose process
    died every time, and why; engine: `local`, with `jobs` processes, or the address of a Dask
    scheduler, `tcp://host:8786`, whose workers see the same files. Raises UsageError, ServerGone.
    """
    if engine == "local":
        return map(work, items) if jobs == 1 else _processes(work, items, lost, jobs)
    if "://" in engine:
        return _cluster(work, items, lost, engine)
    raise UsageError(f"--engine {engine}: there is `local`, or a scheduler's tcp://HOST:PORT")


def _processes(
    work: Callable[[Item], Result],
    items: Sequence[Item],
    lost: Callable[[Item, str], Result],
    jobs: int,
) -> Iterator[Result]:
    """On processes of this machine; where one dies, its items are tried again one by one."""
    again: list[Item] = []
    with processes(jobs) as pool:
        futures = {pool.submit(work, item): item for item in items}
        for future in as_completed(futures):
            try:
                yield future.result()
            except BrokenProcessPool:
                again.append(futures[future])
    for item in again:
        with processes(1) as pool:
            try:
                yield pool.submit(work, item).result()
            except BrokenProcessPool:
                yield lost(item, "its process died twice")


def _cluster(
    work: Callable[[Item], Result],
    items: Sequence[Item],
    lost: Callable[[Item, str], Result],
    address: str,
) -> Iterator[Result]:
    try:
        distributed: Any = import_module("distributed")
    except ImportError as error:
        raise UsageError(
            f"--engine {address} needs Dask: pip install 'thermocald[dask]'"
        ) from error
    try:
        client = distributed.Client(address, timeout="20s", set_as_default=False)
    except (OSError, TimeoutError) as error:
        raise ServerGone(f"{address}: the scheduler cannot be reached ({error})") from error
    with client:
        waiting = list(items)
        for left in reversed(range(_ROUNDS)):
            again: list[Item] = []
            futures = client.map(work, waiting, pure=False, retries=1)
            which = {future.key: item for future, item in zip(futures, waiting, strict=True)}
            for future in distributed.as_completed(futures, loop=client.loop):
                item = which[future.key]
                if future.status == "finished":
                    yield future.result()
                elif left and isinstance(future.exception(), distributed.KilledWorker):
                    # its workers died: of it, or because somebody ends workers now and then
                    again.append(item)
                else:
                    yield lost(item, _first_line(future.exception()))
                future.release()
            waiting = again
            if not waiting:
                return


def _first_line(error: BaseException | None) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
