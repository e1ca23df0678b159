"""The cache of the package: bounds, marks and `clear`."""

import re
from pathlib import Path

import iblf_jax
from iblf_jax.core import caches
from iblf_jax.core.caches import CACHE, Cache


def test_the_least_recently_used_results_leave_and_the_cache_of_the_package_can_be_cleared():
    from iblf_jax.control.controllers.adaptive_rbf import sobol_centres

    cache, calls = Cache(), []

    @cache.memoised(2)
    def square(x):
        calls.append(x)
        return x * x

    assert [square(x) for x in (1, 2, 1, 3, 1, 2)] == [1, 4, 1, 9, 1, 4]
    assert calls == [1, 2, 3, 2]
    assert len(cache) == cache.bound == 2
    cache.clear()
    assert len(cache) == 0 and square(1) == 1 and calls[-1] == 1
    first = sobol_centres(4, 2)
    assert sobol_centres(4, 2) is first and len(CACHE) > 0
    CACHE.clear()
    assert len(CACHE) == 0
    assert (sobol_centres(4, 2) == first).all()


def test_a_mark_is_new_once(monkeypatch):
    """Topics are separate, and the oldest mark leaves."""
    monkeypatch.setattr(caches, "MAX_MARKS", 2)
    cache = Cache()
    assert cache.mark("texts", "a") and not cache.mark("texts", "a")
    assert cache.mark("kernels", "a")
    assert cache.mark("texts", "b") and cache.mark("texts", "c")
    assert not cache.is_marked("texts", "a") and cache.is_marked("texts", "c")
    cache.clear("texts")
    assert not cache.is_marked("texts", "c") and cache.is_marked("kernels", "a")
    cache.clear()
    assert len(cache) == 0


def test_core_world_and_control_have_no_other_cache():
    folders = [Path(iblf_jax.__file__).parent / name for name in ("core", "world", "control")]
    paths = {path for folder in folders for path in folder.rglob("*.py")}
    pattern = r"lru_cache|functools\.cache|import cache\b"
    found = [path.name for path in paths if re.search(pattern, path.read_text())]
    assert set(found) <= {"caches.py"}
