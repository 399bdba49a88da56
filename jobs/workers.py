"""Workers on Dask distributed: a running cluster by its address, or one here with a worker per GPU or core.

A GPU worker sees only its GPU, and a CPU worker uses only its own cores. Anyone who can reach a worker can run code on
it. Local workers listen on the loopback interface, which other users of the machine can still reach. They therefore use
TLS, with keys made for this cluster that exist only in the memory of its processes.
"""

from __future__ import annotations

import asyncio
import logging
import os
import platform
import sys
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from functools import partial
from typing import TYPE_CHECKING, Any

from ..envs.registry import make, source_of
from ..landscapes.draw.loopback import LOOPBACK
from ..landscapes.plain import printable
from .scene import made_over, made_with

if TYPE_CHECKING:
    from ..envs.base import Environment
    from ..landscapes.objective import Objective

LOCAL = "local"
DEAF = (
    "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"  # Ctrl-C is for the command, which ends its workers
)
ANSWER = 10.0  # seconds that a scheduler is given to answer in
SCHEDULER_PAGES, WORKER_PAGES = (f"distributed.{which}.http.routes" for which in ("scheduler", "worker"))
CLOSED = {"tls", "wss"}  # protocols that a scheduler cannot be reached by without a certificate
INSTALL = "pip install '.[distributed]' in gradscape's sources"


@contextmanager
def workers(scheduler: str | None, device: str) -> Iterator[Executor | None]:
    """Give an executor over the workers that `--scheduler` names, None where it names none.

    `scheduler` is the address of a running scheduler, or local[:N] for N workers here that end with the block; `device`
    is what they compute on: cpu, cuda, or auto for CUDA where it is.

    Raises ValueError where Dask is not installed or the workers cannot be as said, ConnectionError where no scheduler
    answers, and WorkersLostError where every worker died of the same work.
    """
    if scheduler is None:
        yield None
        return
    try:
        from distributed import Client, KilledWorker
    except ImportError as error:
        raise ValueError(f"--scheduler needs Dask: {INSTALL} ({error})") from None
    for name in ("distributed", "distributed.client"):  # what matters of what they say is raised
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with ExitStack() as stack:
        address: Any = scheduler
        if scheduler.partition(":")[0] == LOCAL:
            address = stack.enter_context(_local(_count(scheduler), device))
        else:
            _greet(scheduler)
        try:
            client = stack.enter_context(Client(address, timeout=ANSWER))  # type: ignore[no-untyped-call]
        except (OSError, ValueError) as error:
            raise ConnectionError(f"no Dask scheduler answers at {scheduler}: {error}") from error
        if not client.nthreads():
            print(f"waiting for the first worker of {printable(scheduler)}", file=sys.stderr)
            client.wait_for_workers(1)
        try:
            yield client.get_executor(pure=False)
        except KilledWorker as error:
            from ..landscapes.sampling.distribution import WorkersLostError

            said = (
                "a task was given up because every worker that took it died; the rest is kept, and the same command "
                "continues from there"
            )
            raise WorkersLostError(f"{said}: {error}") from error


def _greet(address: str) -> None:
    """Refuse an address where no scheduler answers, which Dask's client would wait for; warn of one without TLS."""
    from distributed.comm import connect, parse_address  # type: ignore[attr-defined]
    from distributed.security import Security

    closed = parse_address(address)[0] in CLOSED
    try:
        how = Security().get_connection_args("client")  # type: ignore[no-untyped-call]
    except OSError as error:
        raise ValueError(f"the certificates that Dask's configuration names cannot be read: {error}") from None
    if closed and how["ssl_context"] is None:
        raise ValueError(f"{address} needs certificates; docs/clusters.md says how to name them")

    async def greeted() -> None:
        comm = await asyncio.wait_for(connect(address, deserialize=False, **how), ANSWER)  # type: ignore[no-untyped-call]
        comm.abort()

    try:
        with ThreadPoolExecutor(1) as beside:  # where this thread runs a loop of its own, as a notebook's does
            beside.submit(asyncio.run, greeted()).result()
    except Exception as error:  # whatever it is that answers there, or does not
        said = f"{error}" or f"no answer within {ANSWER:g} s"
        raise ConnectionError(f"no Dask scheduler answers at {address}: {said}") from error
    if not closed:
        print(
            f"warning: {printable(address)} has no TLS, so anyone who can reach it can run code on its workers and on "
            "this machine; docs/clusters.md says how to secure a cluster",
            file=sys.stderr,
        )


def recipe(objective: Objective) -> partial[Environment] | None:
    """Return what makes an environment in another process, and refuses to make one of another model.

    Any other objective has none, and is sent as it is.
    """
    from ..envs.base import Environment

    if not isinstance(objective, Environment):
        return None
    env = objective
    how = {"fidelity": env.fidelity, "device": env.device, "engine": env.engine, "deterministic": env.deterministic}
    over = made_with(env.identity())
    return partial(_make_checked, source_of(env), env.version_on(env.engine), how | asdict(env.options), over)


def _make_checked(
    source: str | type[Environment] | Environment,
    model: int,
    settings: dict[str, Any],
    over: tuple[str | None, str | None],
) -> Environment:
    env = made_over(make(source, **settings), *over)
    if (theirs := env.version_on(env.engine)) != model:
        raise ValueError(
            f"worker {platform.node()} has {env.name} model {theirs}, but this machine has model {model}; install the "
            "same version there"
        )
    return env


def _count(scheduler: str) -> int | None:
    """Return the N of local:N, None where there is none."""
    _, colon, number = scheduler.partition(":")
    if colon and not (number.isdecimal() and int(number)):
        raise ValueError(f"--scheduler takes an address, local or local:N for N workers; got {scheduler!r}")
    return int(number) if colon else None


def _local(count: int | None, device: str) -> Any:
    """Start a cluster of processes here: workers by number, each with a GPU or with cores of its own."""
    import dask
    from distributed import Nanny, Scheduler, SpecCluster

    places = _gpus(count) if device == "cuda" or (device == "auto" and _names()) else _cores(count)
    security = _keys()
    # Web servers are there without a dashboard, too: they get no pages, and no port that another cluster may have.
    here = {"host": LOOPBACK, "protocol": "tls", "security": security, "dashboard": False}
    common = here | {"nthreads": 1, "memory_limit": 0, "silence_logs": logging.CRITICAL, "config": {WORKER_PAGES: []}}
    specs = {number: {"cls": Nanny, "options": common | place} for number, place in enumerate(places)}
    scheduler = {"cls": Scheduler, "options": here | {"dashboard_address": f"{LOOPBACK}:0", "port": 0}}
    with dask.config.set({SCHEDULER_PAGES: []}):
        return SpecCluster(workers=specs, scheduler=scheduler, security=security, silence_logs=False)  # type: ignore[no-untyped-call]


def _keys() -> Any:
    """Make a certificate that only the processes of one cluster have."""
    from distributed.security import Security

    try:
        return Security.temporary()  # type: ignore[no-untyped-call]
    except ImportError as error:
        raise ValueError(f"--scheduler local needs cryptography: {INSTALL} ({error})") from None


def _gpus(count: int | None) -> list[dict[str, Any]]:
    """Return a Nanny's options for each worker of a GPU, which sees no other."""
    names = _names()
    if count is not None and count > len(names):
        raise ValueError(
            f"--scheduler local:{count} needs {count} GPUs; this machine has {len(names)}, so use local or a smaller N"
        )
    return [{"env": {"CUDA_VISIBLE_DEVICES": name}, "preload": [DEAF]} for name in names[:count]]


def _names() -> list[str]:
    """Return what CUDA_VISIBLE_DEVICES may call each GPU that this process sees."""
    from ..envs.engines.runtime import device_names

    numbers = [str(number) for number, _ in enumerate(device_names())]
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    return named.split(",")[: len(numbers)] if named else numbers


def _cores(count: int | None) -> list[dict[str, Any]]:
    """Return a Nanny's options for each worker of a CPU: one thread of Dask, and its share of the cores."""
    if not hasattr(os, "sched_setaffinity"):
        return [{"preload": [DEAF]} for _ in range(count or os.cpu_count() or 1)]
    cores = sorted(os.sched_getaffinity(0))
    count = count or len(cores)
    shares = [cores[number::count] or [cores[number % len(cores)]] for number in range(count)]
    return [{"preload": [DEAF, f"import os; os.sched_setaffinity(0, {share})"]} for share in shares]
