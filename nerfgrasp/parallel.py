"""Work in many processes, here or on a Ray cluster: progress is shown, dead workers are told and made up for."""

import logging
import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import islice
from types import ModuleType
from typing import Any, Literal, TypeVar

import torch
from joblib import Parallel, cpu_count, delayed, parallel_config
from tqdm import tqdm

from nerfgrasp.allocator import keep_freed_memory
from nerfgrasp.errors import UserError

RESTARTS = 2
"""How often work is taken up again after a worker process died."""
_QUEUED = 2
"""Tasks handed to a Ray cluster for each of its processors, so that none waits for the next."""

T = TypeVar("T")
Cluster = Literal["ray"]


class WorkerDiedError(Exception):
    """A worker process ended without an answer: it was killed, its memory ran out, or its machine went away."""


def run_all(
    job: Callable[[int], T],
    missing: Callable[[], list[int]],
    total: int,
    *,
    workers: int | None = None,
    cluster: Cluster | None = None,
    describe: str,
    unit: str,
    keep: Callable[[T], None] | None = None,
    status: Callable[[T], str] | None = None,
) -> None:
    """Does every piece of work that is missing, in any order, each in one thread.

    Where a worker process dies, that is told on stderr and what is missing then is done by new ones, twice at most.

    Args:
        job: does piece `i`; it travels to other processes by pickling, and so does its result.
        missing: returns the numbers of the pieces that are not done yet.
        total: how many pieces there are, done ones included.
        workers: number of processes; one for each processor of the machine or the cluster if None.
        cluster: `ray` for a Ray cluster: the one that RAY_ADDRESS names, or that runs on this machine, or else one
            started for this work alone. None for processes of this machine.
        describe: what the progress bar says before, e.g. the command's name.
        unit: what it counts.
        keep: takes each result, in this process, as it comes.
        status: returns what the progress bar says after, given a result.

    Raises:
        UserError: workers died three times, or Ray is not installed or cannot be reached.
    """
    left = missing()
    if not left:
        return
    with tqdm(total=total, initial=total - len(left), unit=unit, desc=describe, disable=None) as progress:
        for deaths in range(RESTARTS + 1):
            try:
                for result in _results(job, left, workers, cluster):
                    if keep is not None:
                        keep(result)
                    if status is not None:
                        progress.set_postfix_str(status(result), refresh=False)
                    progress.update()
                return
            except WorkerDiedError as error:
                left = missing()
                progress.n = total - len(left)
                if deaths == RESTARTS:
                    message = f"worker processes died {deaths + 1} times (out of memory?)"
                    raise UserError(f"{message}: try fewer workers; the same command continues") from error
                lost = f"{describe}: a worker process died (killed, or out of memory?)"
                progress.write(f"{lost}; going on with the {len(left)} {unit}s left", file=sys.stderr)


def _results(job: Callable[[int], T], left: list[int], workers: int | None, cluster: Cluster | None) -> Iterator[T]:
    if cluster == "ray":
        return _on_ray(job, left, workers)
    return _on_this_machine(job, left, cpu_count() if workers is None else workers)


def _on_this_machine(job: Callable[[int], T], left: list[int], workers: int) -> Iterator[T]:
    # One job alone runs in this process, which may not die of the last piece where workers were asked for.
    with parallel_config("loky", n_jobs=min(workers, max(len(left), 2)), inner_max_num_threads=1):
        # One piece takes far longer than handing it out: no batches, so that a killed run loses little.
        parallel = Parallel(return_as="generator_unordered", batch_size=1)
        try:
            yield from parallel(delayed(_in_one_thread)(job, index) for index in left)
        except BrokenProcessPool as error:
            raise WorkerDiedError from error


def _on_ray(job: Callable[[int], T], left: list[int], workers: int | None) -> Iterator[T]:
    with _ray_cluster() as ray:
        limit = workers or _QUEUED * int(ray.cluster_resources().get("CPU", 1))
        # Ray's own retries happen unseen: none, so that a dead worker is told as it is without a cluster.
        task = ray.remote(num_cpus=1, max_retries=0)(_in_one_thread)
        waiting, shared = iter(left), ray.put(job)
        running: list[Any] = []
        try:
            while True:
                running += [task.remote(shared, index) for index in islice(waiting, limit - len(running))]
                if not running:
                    return
                (done,), running = ray.wait(running, num_returns=1)
                yield _ray_result(ray, done)
        finally:
            for reference in running:
                ray.cancel(reference, force=True)


def _ray_result(ray: ModuleType, reference: Any) -> Any:
    try:
        return ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        # Its message is a traceback; the error itself may be the user's, to be told in one line.
        raise error.cause from error
    except ray.exceptions.RayError as error:
        raise WorkerDiedError from error


@contextmanager
def _ray_cluster() -> Iterator[ModuleType]:
    """Yields Ray, connected to a cluster; what is started here is stopped here."""
    # A cluster of our own tells nobody about itself, and does not forward what workers print.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
    except ModuleNotFoundError as error:
        raise UserError("--cluster ray needs Ray: pip install 'nerfgrasp[cluster]'") from error
    connected_here = not ray.is_initialized()
    if connected_here:
        try:
            ray.init(include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR)
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise UserError(f"cannot reach or start a Ray cluster: {error}") from error
    try:
        yield ray
    finally:
        if connected_here:
            ray.shutdown()


def _in_one_thread(job: Callable[[int], T], index: int) -> T:
    """Does one piece; sums then never depend on how many processors there are.

    Pieces are alike, so the memory that one frees is kept for the next: pictures take 0.7 of the time.
    """
    keep_freed_memory()
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return job(index)
    finally:
        torch.set_num_threads(threads)
