"""Scans measured by several processes, of this machine or of a Dask cluster."""

from __future__ import annotations

import contextlib
import itertools
import logging
import warnings
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from octn_ros.errors import ConfigurationError
from octn_ros.evaluation.environment import code_hash
from octn_ros.evaluation.kept_rows import ScanResult
from octn_ros.evaluation.scans import ScanSource

if TYPE_CHECKING:
    from distributed import Client

    from octn_ros.evaluation.engine import Work

_CONNECT_S = 20
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")


def measure_side_by_side(
    sources: Sequence[ScanSource], work: Work, processes: int, scheduler: str | None = None
) -> Iterator[tuple[int, ScanResult | Exception]]:
    """Yield the number of each scan and what became of it, as they are done.

    A worker that dies, for want of memory perhaps, fails its scan alone. Scans are loaded where they are measured:
    the workers of a cluster need the files under the same paths.

    Args:
        sources: the scans.
        work: what is done with each.
        processes: of this machine, which share its cores; with a scheduler they are those of its cluster.
        scheduler: address of a running Dask scheduler, None to start processes here.

    Raises:
        ConfigurationError: Dask is missing, the scheduler does not answer, has no workers, or they run other code.
    """
    try:
        import distributed
    except ImportError as error:
        raise ConfigurationError("scheduler: expected Dask to be installed; pip install 'octn_ros[bench]'") from error
    with _client(processes, scheduler) as client:
        waiting = iter(enumerate(sources))
        numbers: dict[object, int] = {}
        done = distributed.as_completed(loop=client.loop)

        def submit_next() -> None:
            for number, source in itertools.islice(waiting, 1):
                future = client.submit(_measure, source, work, pure=False, retries=0)
                numbers[future.key] = number
                done.add(future)

        # One scan for each thread: others that waited for a worker that dies would be taken for what it died of.
        for _ in range(sum(client.nthreads().values())):
            submit_next()
        try:
            for future in done:
                failure = future.exception()
                number = numbers[future.key]
                yield number, future.result() if failure is None else _plain(failure)
                submit_next()
        finally:  # whoever stops listening wants no more work done
            client.cancel(list(done.futures))


def _measure(source: ScanSource, work: Work) -> ScanResult:
    return work(source.load())


@contextlib.contextmanager
def _client(processes: int, scheduler: str | None) -> Iterator[Client]:
    import dask
    from distributed import Client, LocalCluster

    if scheduler is not None:
        try:
            client = Client(scheduler, timeout=_CONNECT_S, set_as_default=False)
        except (OSError, ValueError) as error:
            raise ConfigurationError(
                f"scheduler: expected the address of a running Dask scheduler, got {scheduler!r} ({error})"
            ) from error
        with client:
            _check_workers(client, scheduler)
            yield client
        return
    from octn_ros.evaluation.engine import cores

    threads = str(max(1, cores() // processes))
    settings = {
        "distributed.nanny.pre-spawn-environ": dict.fromkeys(_THREAD_VARIABLES, threads),
        # A scan that a worker died of would kill the next one too.
        "distributed.scheduler.allowed-failures": 0,
    }
    with dask.config.set(settings), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a port that is taken, of a dashboard that nobody asked for
        with (
            LocalCluster(
                n_workers=processes, threads_per_worker=1, dashboard_address=None, silence_logs=logging.CRITICAL
            ) as cluster,
            Client(cluster, set_as_default=False) as client,
        ):
            yield client


def _check_workers(client: Client, scheduler: str) -> None:
    hashes = client.run(code_hash)
    if not hashes:
        raise ConfigurationError(f"scheduler: expected one with workers, {scheduler} has none; start dask worker")
    others = sorted(worker for worker, value in hashes.items() if value != code_hash())
    if others:
        raise ConfigurationError(
            f"scheduler: expected workers with this octn_ros, {', '.join(others)} have other code; install the same"
        )


def _plain(error: BaseException) -> Exception:
    return error if isinstance(error, Exception) else RuntimeError(str(error))
