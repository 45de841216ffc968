"""Processes that compute side by side."""

from __future__ import annotations

import os
from typing import Any

import joblib

from experiments.orphans import end_with


def parallel(num_workers: int | None, **options: Any) -> joblib.Parallel:
    """``joblib.Parallel``, whose workers end with this process however it ends.

    Left alone, they would wait 300 seconds for more work from a parent that is no more.
    """
    return joblib.Parallel(
        n_jobs=num_workers, initializer=end_with, initargs=(os.getpid(),), **options
    )
