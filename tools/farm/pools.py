"""Where tasks run: processes of this computer or a Dask cluster's workers, each with one thread for numerics."""

import importlib
import multiprocessing
import os
from collections.abc import Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any

from weldcal.models.errors import InputError, WeldcalError
from weldcal.tools.console import plain

FAILED = "failed"
Tasks = Mapping[str, tuple[str, Mapping[str, Any]]]
"""By key: the function ("package.module:name") and its keyword arguments."""

MEMORY_GIB = 1.5  # of one process that holds Drake, Open3D and a rendered cell
REACH_S = 10.0


def run_task(function: str, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Call ``function`` ("package.module:name") with keyword arguments; its result in JSON's own types.

    A WeldcalError becomes {"state": "failed", "reason": ...}: one task that cannot be done does not end a study.
    """
    import cv2
    from threadpoolctl import threadpool_limits

    module, name = function.split(":")
    call = getattr(importlib.import_module(module), name)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with threadpool_limits(1):
            found = plain(call(**arguments))
    except WeldcalError as error:
        return {"state": FAILED, "reason": str(error)}
    finally:
        cv2.setNumThreads(threads)
    if not isinstance(found, dict):
        raise TypeError(f"{function} returns a {type(found).__name__}. A task returns a mapping.")
    return found


class WorkerLost(WeldcalError):
    """A process that computed a task has ended, perhaps for want of memory."""


def processes_here() -> int:
    """Processes that this computer has cores and memory for, at least one."""
    cores = len(os.sched_getaffinity(0))
    free_gib = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30
    return max(1, min(cores, int(free_gib / MEMORY_GIB)))


def in_this_process(tasks: Tasks) -> Iterator[tuple[str, dict[str, Any]]]:
    """Results one after the other, by key: for tasks that take less time than a new process, or measure this one."""
    for key, (function, arguments) in tasks.items():
        yield key, run_task(function, arguments)


def on_this_computer(tasks: Tasks, workers: int) -> Iterator[tuple[str, dict[str, Any]]]:
    """Results as they are ready, by key.

    Raises:
        WorkerLost: a process has ended.
    """
    context = multiprocessing.get_context("spawn")
    with _one_thread(), ProcessPoolExecutor(min(workers, len(tasks)), mp_context=context) as pool:
        waiting: dict[Future[dict[str, Any]], str] = {
            pool.submit(run_task, function, arguments): key for key, (function, arguments) in tasks.items()
        }
        try:
            while waiting:
                for done in wait(waiting, return_when=FIRST_COMPLETED).done:
                    yield waiting.pop(done), done.result()
        except BrokenProcessPool as error:
            raise WorkerLost(
                "A process that computed a task has ended, perhaps for want of memory. "
                "Run the command again with the same --out and fewer --workers: it goes on where it stopped."
            ) from error
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def on_dask(tasks: Tasks, scheduler: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Results of a Dask cluster's workers as they are ready, by key. The workers need weldcal and the same files.

    Raises:
        InputError: no Dask here, or no scheduler at this address.
    """
    try:
        distributed: Any = importlib.import_module("distributed")
    except ImportError as missing:
        raise InputError("--scheduler needs Dask: pip install 'weldcal[dask]'.") from missing
    try:
        client = distributed.Client(scheduler, timeout=REACH_S)
    except (OSError, ValueError, TimeoutError) as problem:
        raise InputError(
            f"No Dask scheduler answers at '{scheduler}'. Start one with `dask scheduler`, or give its tcp:// address."
        ) from problem
    with client:
        waiting = {
            client.submit(run_task, function, dict(arguments), pure=False, retries=2): key
            for key, (function, arguments) in tasks.items()
        }
        for done in distributed.as_completed(list(waiting)):
            yield waiting[done], done.result()


@contextmanager
def _one_thread() -> Iterator[None]:
    """Libraries of the processes started meanwhile begin with one thread: as many processes as cores need no more."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
