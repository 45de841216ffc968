"""Jobs on a cluster: a scheduler and two worker processes of this machine, killed one by one."""

import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest
import torch
import toy_experiment
from toy_experiment import CELLS, fill

from experiments import origin
from experiments.store import Store
from experiments.work import ADDRESS, WorkError, finished, num_at_once

CLUSTER = """
from distributed import LocalCluster
cluster = LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)
print(cluster.scheduler_address, flush=True)
input()
"""


@pytest.mark.parametrize("num_workers", [1, 2])
def test_a_job_has_one_thread_whoever_runs_it(num_workers):
    before = torch.get_num_threads()
    assert list(finished([torch.get_num_threads] * 2, num_workers)) == [1, 1]
    assert torch.get_num_threads() == before


@pytest.fixture(scope="module")
def cluster():
    """The process of a scheduler, and its address."""
    paths = {"PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.Popen(
        [sys.executable, "-c", CLUSTER],
        env=os.environ | paths,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    yield process, process.stdout.readline().strip()
    process.kill()
    process.wait()


@pytest.fixture
def address(cluster) -> str:
    return cluster[1]


def run(cell, seeds, checkpoints):
    """The toy; but who finds the number of a process in the folder kills it, once.

    It waits until as many batches as the note says are saved; of process 0, it kills its own.
    """
    note = Path(checkpoints) / f"{cell.method}_{cell.size}"
    if note.exists():
        victim, num_saved = map(int, note.read_text().split())
        note.unlink()
        while len(Store(note.parent, "toy").batches()) < num_saved:
            time.sleep(0.05)
        os.kill(victim or os.getpid(), signal.SIGKILL)
        time.sleep(60)
    return toy_experiment.run(cell, seeds)


def here(folder: Path, **options):
    return fill(folder, run=partial(run, checkpoints=folder), **options)


def written(folder: Path) -> tuple[str, list]:
    """Rows and origins as they are on disk, without what is different in every run."""
    differs = ("cpu_seconds", "wall_seconds", "finished")
    batches = Store(folder, "toy").batches()
    same = [{k: v for k, v in batch.items() if k not in differs} for batch in batches]
    return (folder / "toy.csv").read_text(), same


def fails():
    raise ZeroDivisionError("of the job")


def test_rows_are_those_of_processes(address, tmp_path):
    here(tmp_path / "joblib")
    here(tmp_path / "dask", scheduler=address)
    assert written(tmp_path / "dask") == written(tmp_path / "joblib")
    assert num_at_once(1, address) == 2


def test_batch_of_a_killed_worker_is_computed_again(address, tmp_path):
    here(tmp_path / "whole")
    (tmp_path / "killed").mkdir()
    note = tmp_path / "killed" / "fast_10"
    note.write_text("0 1")
    here(tmp_path / "killed", scheduler=address)
    assert not note.exists()
    assert written(tmp_path / "killed") == written(tmp_path / "whole")


def test_error_of_a_job_arrives(address, monkeypatch):
    monkeypatch.setenv(ADDRESS, address)
    with pytest.raises(ZeroDivisionError, match="of the job"):
        list(finished([fails]))


def test_worker_that_is_not_like_us_is_refused(address, monkeypatch):
    monkeypatch.setattr(origin, "commit", lambda: "another")
    with pytest.raises(WorkError, match=r"worker tcp://.*: commit = .*, must be 'another' as here"):
        list(finished([fails], scheduler=address))


@pytest.mark.parametrize("scheduler", ["tcp://127.0.0.1:9", "somewhere"])
def test_scheduler_that_is_not_there_is_named(scheduler):
    with pytest.raises(WorkError, match=rf"scheduler = '{scheduler}': cannot be reached: "):
        list(finished([fails], scheduler=scheduler))


def test_nothing_is_lost_with_the_scheduler(cluster, tmp_path):
    """The last test: the scheduler does not come back."""
    process, address = cluster
    here(tmp_path / "whole")
    folder = tmp_path / "lost"
    folder.mkdir()
    (folder / "fast_2").write_text(f"{process.pid} 2")
    with pytest.raises(
        WorkError, match=r"was lost\. What was finished is saved, and the same call"
    ):
        here(folder, scheduler=address)
    assert [batch["columns"] for batch in Store(folder, "toy").batches()] == [
        cell.columns for cell in (CELLS[1], CELLS[0])
    ]
    here(folder)
    assert written(folder) == written(tmp_path / "whole")
