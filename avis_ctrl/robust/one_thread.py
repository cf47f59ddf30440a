"""Limit to one BLAS thread for many small matrices; the libraries are located only once (it takes milliseconds)."""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import cache

from threadpoolctl import ThreadpoolController


@cache
def _libraries() -> ThreadpoolController:
    return ThreadpoolController()


def one_thread() -> AbstractContextManager[object]:
    """Context in which the BLAS and OpenMP libraries loaded at the first call use one thread."""
    return _libraries().limit(limits=1)
