"""Dask distributed: a cluster of two here, workers that die, a scheduler that is gone, the command over an address."""

import asyncio
import os
import signal
import socket
import ssl
import subprocess
import sys
import threading
import uuid
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import urlopen

import cloudpickle
import dask
import distributed  # noqa: F401 -- whose settings are to be there before a test changes some for a while
import numpy as np
import pytest
import torch
from distributed.comm import connect
from distributed.security import Security

from gradscape.envs.adapters import from_torch
from gradscape.envs.functions import Branin
from gradscape.envs.registry import make
from gradscape.jobs.folder import SLICE
from gradscape.jobs.slice import STORE
from gradscape.jobs.workers import recipe, workers
from gradscape.landscapes.plane import Plane
from gradscape.landscapes.sampling.distribution import AHEAD, WorkersLostError
from gradscape.landscapes.sampling.fill import sample
from gradscape.landscapes.space import ParameterSpace
from gradscape.landscapes.storage.store import SliceStore, open_slice
from gradscape.optim.runs.store import RunStore

from .sockets import beyond_loopback, listening

pytestmark = pytest.mark.e2e

cloudpickle.register_pickle_by_value(sys.modules[__name__])  # workers need not find the tests
SPACE = ParameterSpace.box(("x", "y", "z"), -2.0, 2.0, "m")
PLANE = Plane.through(SPACE, SPACE.center, ["x", "z"], resolution=(18, 16))
PATIENCE = 600.0  # seconds, for schedulers that do answer, on a machine that has other things to do


@pytest.fixture(scope="module")
def machine():
    """Give the tests of a cluster all cores, of which others have one each."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, range(os.cpu_count() or 1))
    yield
    os.sched_setaffinity(0, before)


@pytest.fixture(scope="module")
def executor(machine):
    """Give two workers, where another cluster has Dask's usual port."""
    with socket.socket() as usual, pytest.MonkeyPatch.context() as patch:
        patch.setattr("gradscape.jobs.workers.ANSWER", PATIENCE)
        with suppress(OSError):  # another cluster has it indeed
            usual.bind(("127.0.0.1", 8787))
            usual.listen()
        with dask.config.set({"distributed.comm.timeouts.connect": f"{PATIENCE}s"}), workers("local:2", "cpu") as found:
            yield found


@pytest.fixture
def address(executor):
    """Give the address of its scheduler, whose keys Dask's configuration has."""
    keys = executor._client.security
    named = {"ca-file": keys.tls_ca_file, "client.cert": keys.tls_client_cert, "client.key": keys.tls_client_key}
    with dask.config.set({f"distributed.comm.tls.{name}": value for name, value in named.items()}):
        yield executor._client.scheduler.address


def addresses(executor) -> list[str]:
    """Return where the scheduler listens, the workers and what watches over them."""
    workers = executor._client.scheduler_info(n_workers=-1)["workers"]
    return [executor._client.scheduler.address, *workers, *(one["nanny"] for one in workers.values())]


def met(address: str, context: ssl.SSLContext | None) -> None:
    async def greeted() -> None:
        comm = await connect(address, ssl_context=context)
        comm.abort()

    with ThreadPoolExecutor(1) as beside:  # of this thread, in which a browser's tests may have left a loop
        beside.submit(asyncio.run, greeted()).result()


def context_of(keys: Security) -> ssl.SSLContext:
    return keys.get_connection_args("client")["ssl_context"]


def test_workers_here_listen_to_this_machine_and_to_holders_of_their_keys(executor):
    assert len(listening()) >= len(addresses(executor)) == 5
    assert beyond_loopback(listening()) == []
    careless = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)  # which takes any server, and has no key
    careless.check_hostname, careless.verify_mode = False, ssl.CERT_NONE
    for address in addresses(executor):
        met(address, context_of(executor._client.security))
        with pytest.raises(OSError, match="certificate does not match"):
            met(address, context_of(Security.temporary()))
        with pytest.raises(OSError, match=r"closed|required"):
            met(address, careless)
        with pytest.raises(OSError, match="closed"):
            met(address.replace("tls://", "tcp://"), None)


def test_their_web_servers_have_no_pages(executor):
    found = executor._client.scheduler_info(n_workers=-1)
    ports = [one["services"]["dashboard"] for one in (found, *found["workers"].values())]
    assert len(ports) == 3
    for port in ports:
        for page in ("health", "info/main/workers.html", "metrics"):
            with pytest.raises(HTTPError, match="404") as refused:
                urlopen(f"http://127.0.0.1:{port}/{page}")
            refused.value.close()


def store_at(path: Path, plane: Plane = PLANE, space: ParameterSpace = SPACE) -> SliceStore:
    return SliceStore.open_or_create(path, plane, space, identity={})


def same(one, other) -> bool:
    alike = [one[name].to_numpy().tobytes() == other[name].to_numpy().tobytes() for name in one.data_vars]
    return set(one.data_vars) == set(other.data_vars) and "loss" in one and all(alike)


def wave(x: torch.Tensor) -> torch.Tensor:
    return (3 * x).sin().prod(dim=1) + x.exp().sum(dim=1)


def test_two_workers_write_the_bits_of_one_process(tmp_path, executor):
    env = make("bounce", fidelity="draft", device="cpu")
    plane = Plane.through(env.space, env.example("aim"), [0, 1], resolution=20)
    alone = sample(env, plane, store_at(tmp_path / "alone.zarr", plane, env.space))
    shared = store_at(tmp_path / "shared.zarr", plane, env.space)
    assert same(sample(env, plane, shared, batch=32, executor=executor, made=recipe(env)), alone)


def test_a_worker_whose_scene_has_another_model_is_refused(monkeypatch):
    made = recipe(make("branin"))
    assert made().name == "branin"
    monkeypatch.setattr(Branin, "model_version", 2)
    with pytest.raises(ValueError, match=r"has branin model 2, but this machine has model 1; install the same version"):
        made()


def test_a_worker_has_a_core_and_a_thread_of_its_own(executor):
    client = executor._client
    cores = client.run(lambda: tuple(sorted(os.sched_getaffinity(0))))
    assert set().union(*cores.values()) == os.sched_getaffinity(0)
    assert len(set(cores.values())) == min(2, len(os.sched_getaffinity(0)))
    assert set(client.run(torch.get_num_threads).values()) == {1}


def deadly(x: torch.Tensor, marks: Path) -> torch.Tensor:
    """Leave a mark of every evaluation, and kill the first process that comes to the far edge."""
    (marks / uuid.uuid4().hex).write_text(" ".join(str(row) for row in x.tolist()))
    if bool((x[:, 0] == SPACE.upper[0]).any()):
        with suppress(FileExistsError):
            (marks / "killed").touch(exist_ok=False)
            os.kill(os.getpid(), signal.SIGKILL)
    return wave(x)


def test_killing_a_worker_loses_nothing_and_repeats_no_more_than_it_held(tmp_path, executor):
    marks, seen = tmp_path / "marks", []
    marks.mkdir()
    store = store_at(tmp_path / "s.zarr")
    objective = from_torch(partial(deadly, marks=marks), SPACE, name="deadly")
    dataset = sample(objective, PLANE, store, batch=20, executor=executor, progress=seen.append)
    assert same(dataset, sample(from_torch(wave, SPACE), PLANE))
    assert [now.done for now in seen] == sorted({now.done for now in seen})
    (marks / "killed").unlink()
    points = [mark.read_text() for mark in marks.iterdir()]
    again = len(points) - len(set(points))
    assert 1 <= again <= 2 * AHEAD  # the killed batch, and what its worker had done of the tasks that two workers have


SCHEDULER = """
import asyncio
from distributed import Scheduler

async def serve():
    async with Scheduler(host="127.0.0.1", port=0, dashboard=False) as scheduler:
        print(scheduler.address, flush=True)
        await scheduler.finished()

asyncio.run(serve())
"""
WORKER = ["distributed.cli.dask_worker", "--no-nanny", "--nthreads", "1", "--no-dashboard"]


@pytest.fixture
def mortal():
    """Give the address and the process of a scheduler that may be killed, and that has a worker."""
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    scheduler = subprocess.Popen([sys.executable, "-c", SCHEDULER], stdout=subprocess.PIPE, text=True)
    address = scheduler.stdout.readline().strip()
    assert address, "the scheduler ended"
    worker = subprocess.Popen([sys.executable, "-m", *WORKER, address], **quiet)
    try:
        yield address, scheduler
    finally:
        for process in (scheduler, worker):
            process.kill()
            process.wait()
        scheduler.stdout.close()


def once(x: torch.Tensor, mark: Path) -> torch.Tensor:
    """Evaluate one batch; every other takes until the worker is killed."""
    try:
        mark.touch(exist_ok=False)
    except FileExistsError:
        threading.Event().wait()
    return wave(x)


def test_a_scheduler_that_is_gone_ends_it_with_a_slice_to_go_on_with(tmp_path, mortal, monkeypatch, capsys):
    monkeypatch.setattr("gradscape.jobs.workers.ANSWER", PATIENCE)
    address, scheduler = mortal
    store = store_at(tmp_path / "s.zarr")

    def kill(now):
        if now.done:
            scheduler.kill()

    gone = r"the workers are gone .*; 16 of 288 points are kept in .*s\.filling.*the same command continues"
    objective = from_torch(partial(once, mark=tmp_path / "mark"), SPACE)
    with pytest.raises(WorkersLostError, match=gone), workers(address, "cpu") as executor:
        sample(objective, PLANE, store, batch=1, executor=executor, progress=kill)
    (warning,) = (line for line in capsys.readouterr().err.splitlines() if "warning" in line)
    assert warning.startswith(f"warning: {address} has no TLS")
    assert len(store.pending()) == len(store.tiles()) - 1
    assert same(sample(from_torch(wave, SPACE), PLANE, store), sample(from_torch(wave, SPACE), PLANE))


def test_a_slice_and_a_sweep_go_over_an_address(tmp_path, run, address):
    how = ["--dims", "0", "1", "--resolution", "8", "--device", "cpu"]
    film = ["--over", "2", "--frames", "2", "--no-gradients"]
    for verb, more, stores in (("slice", [], [STORE]), ("sweep", film, ["frames/000.zarr", "frames/001.zarr"])):
        alone = run(verb, "bounce", *how, *more, "--out", f"{verb}-alone")
        spread = run(verb, "bounce", *how, *more, "--out", f"{verb}-spread", "--scheduler", address)
        assert (alone.returncode, spread.returncode) == (0, 0), alone.stderr + spread.stderr
        assert "warning" not in spread.stderr
        for store in stores:
            assert same(open_slice(tmp_path / f"{verb}-alone" / store), open_slice(tmp_path / f"{verb}-spread" / store))


def test_a_race_has_the_same_runs_whoever_searches(tmp_path, run, address):
    how = ["race", "bounce", "--methods", "random,cma-es", "--budget", "20", "--seeds", "2", "--device", "cpu"]
    run.ok(*how, "--out", "alone")
    run.ok(*how, "--out", "spread", "--scheduler", address)
    runs = sorted(path.relative_to(tmp_path / "alone") for path in (tmp_path / "alone").glob("*/run.zarr"))
    assert len(runs) == 4
    for path in runs:
        one, other = (RunStore.open(tmp_path / where / path).dataset() for where in ("alone", "spread"))
        np.testing.assert_array_equal(one["x"], other["x"])
        np.testing.assert_array_equal(one["loss"], other["loss"])


def test_the_gallerys_slices_go_over_an_address(tmp_path, run, address):
    how = ["gallery", "compute", "--only", "bounce", "--part", "slices", "--fidelity", "draft", "--device", "cpu"]
    run.ok(*how, "--resolution", "8", "--data", str(tmp_path / "data"), "--scheduler", address)
    assert list((tmp_path / "data").glob(f"*/{SLICE.files[0]}"))


DEAD, CLOSED = "tcp://127.0.0.1:9", "tls://127.0.0.1:9"


@pytest.mark.parametrize(
    ("scheduler", "code", "said", "keys", "lacking"),
    [
        ("local:0", 2, "local:N for N workers", {}, ""),
        ("local:two", 2, "local:N for N workers", {}, ""),
        (CLOSED, 2, f"{CLOSED} needs certificates; docs/clusters.md says how to name them", {}, ""),
        (CLOSED, 2, "configuration names cannot be read", {"ca-file": "/none", "client.cert": "/none"}, ""),
        (DEAD, 1, f"no Dask scheduler answers at {DEAD}", {}, ""),
        (DEAD, 2, "pip install '.[distributed]'", {}, "distributed"),
        ("local:1", 2, "--scheduler local needs cryptography: pip install '.[distributed]'", {}, "cryptography"),
    ],
)
def test_what_is_no_scheduler_is_refused_in_a_line(run, monkeypatch, scheduler, code, said, keys, lacking):
    monkeypatch.setattr("gradscape.jobs.workers.ANSWER", 1.0)
    if lacking:
        monkeypatch.setitem(sys.modules, lacking, None)
    with dask.config.set({f"distributed.comm.tls.{name}": value for name, value in keys.items()}):
        done = run(f"slice branin --dims 0 1 --scheduler {scheduler}")
    assert (done.returncode, done.stderr.count("\n")) == (code, 1)
    assert said in done.stderr


def test_what_listens_at_an_address_and_is_no_scheduler_is_not_waited_for(run, monkeypatch):
    monkeypatch.setattr("gradscape.jobs.workers.ANSWER", 0.1)
    with socket.create_server(("127.0.0.1", 0)) as mute:
        address = f"tcp://127.0.0.1:{mute.getsockname()[1]}"
        said = run("slice", "branin", "--dims", "0", "1", "--scheduler", address)
    assert (said.returncode, said.stderr.count("\n")) == (1, 1)
    assert f"no Dask scheduler answers at {address}: no answer within 0.1 s" in said.stderr
