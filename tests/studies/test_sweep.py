"""Sweeps: results, common random numbers, designs, refusals; stores: killed, torn, foreign."""

import contextlib
import errno
import json
import os
import pickle
import random
import shutil
import signal
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import study_cases as cases
from refused import assert_refused

import iblf_jax as ij
from iblf_jax.engine import native
from iblf_jax.kernels import toolchain
from iblf_jax.studies import interrupt, store

SCENARIO = ij.presets.zhang_yan_2024()


@pytest.fixture(scope="module")
def table():
    return cases.table()


@pytest.fixture(scope="module")
def written(tmp_path_factory, table):
    """A finished store, to be copied."""
    path = tmp_path_factory.mktemp("finished") / "sweep.zarr"
    assert cases.table(store=path).identical(table)
    return path


@pytest.fixture
def finished(written, tmp_path):
    return Path(shutil.copytree(written, tmp_path / "sweep.zarr"))


def once(**more):
    """A small sweep without perturbed runs."""
    return ij.sweep(SCENARIO, more.pop("grid", cases.GRID), **cases.options() | more)


@pytest.mark.slow
def test_a_table_is_labelled_and_its_points_are_the_studies_of_their_scenarios(table):
    """Common random numbers: run r of every point draws what run r of a study does."""
    expected = {"controller.K2": 3, "observer.kf": 2, "run": 500, "joint": 2}
    assert dict(table.margin.sizes) == expected
    assert table["controller.K2"].attrs["units"] == "N m s/rad"
    assert table.margin.attrs["units"] == "rad" and table["plant.mass[1]"].dims == ("run",)
    assert table.status.attrs["flag_meanings"].startswith("bound_violated not_finite")
    config = json.loads(table.attrs["config"])
    assert config["seed"] == 3 and config["versions"]["iblf_jax"] == ij.__version__
    assert config["scenario"]["plant.mass"] == pytest.approx([2.0, 0.85])
    for K2, kf in ((10.0, 20.0), (40.0, 10.0)):
        there = ij.with_parameters(SCENARIO, {"controller.K2": K2, "observer.kf": kf})
        study = ij.monte_carlo(there, cases.perturbations(), runs=500, **cases.options())
        point = table.sel({"controller.K2": K2, "observer.kf": kf})
        np.testing.assert_allclose(point.margin, study.metrics.margin, atol=1e-6)
        np.testing.assert_array_equal(point.status, study.status)
        mass = study.samples["plant.mass[1]"]
        np.testing.assert_allclose(table["plant.mass[1]"], mass, rtol=1e-6)


@pytest.mark.slow
def test_designs_vectors_and_empty_grids():
    kf = ij.factor(ij.log_uniform(0.5, 2.0), shared=True)
    ways = {"controller.K2": ij.uniform(10.0, 40.0), "observer.kf": kf}
    for design in ("random", "latin_hypercube"):
        found = once(grid=ways, design=ij.studies.Design(design, points=5))
        assert found.sizes == {"point": 5, "joint": 2}
        assert np.all((found["controller.K2"] > 10) & (found["controller.K2"] < 40))
        np.testing.assert_array_equal(found["observer.kf"][:, 0], found["observer.kf"][:, 1])
    found = once(grid={"controller.K2": [[10.0, 20.0], [30.0, 40.0]], "initial.q": [0.8, 2.0]})
    assert found["controller.K2_values"].values.tolist() == [[10, 20], [30, 40]]
    assert found.margin.sizes == {"controller.K2": 2, "initial.q": 2, "joint": 2}
    assert np.all(found.status.sel({"initial.q": 0.8}) == 0)
    violated = found.status.sel({"initial.q": 2.0}) & int(ij.Status.BOUND_VIOLATED)
    assert np.all(violated), "a flag, not an error"
    ways = {"controller.K2": ij.factor(ij.uniform(0.9, 1.1))}
    data = once(grid={}, perturbations=ways, runs=2)
    assert dict(data["margin"].sizes) == {"run": 2, "joint": 2} and data.attrs["cases"] == 2


@pytest.mark.parametrize(
    ("grid", "more", "message"),
    [
        ({"controller.K3": [1.0]}, {}, "controller.K2"),
        ({"controller.K2": 10.0}, {}, "list of numbers"),
        ({"controller.K2": [[1.0, 2.0, 3.0]]}, {}, "shape"),
        ({"controller.K2": [10.0, -1.0]}, {}, "> 0"),
        ({"controller.K2": [10.0, 10.0]}, {}, "differ"),
        ({"controller.K2": ij.uniform(1.0, 2.0)}, {}, "random"),
        ({"controller.K2": [10.0], "controller.K2[0]": [10.0]}, {}, "overlap"),
        ({"controller.K2": [10.0]}, {"design": ij.studies.Design("random", 3)}, "distribution"),
        ({"controller.K2": ij.uniform(1.0, 2.0)}, {"design": "random"}, "points"),
        ({"controller.K2": [10.0]}, {"runs": 3}, "perturbations"),
        ({}, {}, "vary"),
        ([1.0], {}, "mapping"),
    ],
)
def test_bad_grids_are_refused(grid, more, message):
    assert_refused(message, ij.sweep, SCENARIO, grid, duration=0.01, **more)


LOADED = ij.with_parameters(SCENARIO, {"plant.payload": 1.0})
OTHER_CALLS = {
    "seed: the store has 3, this call 4": {"seed": 4},
    "duration: the store has 0.02, this call 0.04": {"duration": 0.04},
    "unit: the store has 256, this call 512": {"unit": 512},
    "scenario.plant.payload: the store has 0.0, this call 1.0": {"scenario": LOADED},
    "structure.controller.*corrected": {"scenario": ij.presets.zhang_yan_2024(variant="corrected")},
    "backend": {"backend": "vmap"},
}
"""What is refused -> what differs."""


@pytest.mark.slow
def test_a_store_opens_with_xarray_and_load_and_another_call_is_refused(written, finished, table):
    before = cases.arrays(ij.load_sweep(finished))
    for message, change in OTHER_CALLS.items():
        with pytest.raises(ij.StoreError, match=message) as caught:
            cases.table(store=finished, **change)
        assert "program" not in str(caught.value)
    assert cases.same(before, cases.arrays(ij.load_sweep(finished)))
    # What it ran on, not what was asked for.
    assert ij.load_sweep(finished).attrs["backend"] in ("native", "vmap")
    flat = pytest.importorskip("xarray").open_zarr(written, chunks=None)
    assert flat.margin.dims == ("case", "joint")
    assert ij.load_sweep(written).identical(table)


@pytest.mark.skipif(native.unavailable() is not None, reason="no C++ compiler")
def test_another_processor_is_named(finished, table, monkeypatch):
    if ij.load_sweep(finished).attrs["backend"] != "native":
        pytest.skip("the store is not tied to a processor")
    monkeypatch.setattr(toolchain, "processor", lambda: "model name : Another 9000\nflags : avx")
    words = r"kernel.processor: the store has .*Another 9000.*machine of the same kind.*vmap"
    with pytest.raises(ij.StoreError, match=words) as caught:
        cases.table(store=finished)
    assert "program" not in str(caught.value)


def chunks(path, name="margin"):
    return sorted(file for file in (path / name / "c").rglob("*") if file.is_file())


def test_torn_missing_and_foreign_chunks_are_found(finished, table, tmp_path):
    """At last whole units copied from a store of another seed, marks included."""
    torn, missing, foreign = chunks(finished)[:3]
    torn.write_bytes(torn.read_bytes()[:-7])
    missing.unlink()
    foreign.write_bytes(chunks(finished)[5].read_bytes())
    assert_refused("unit 0 is damaged", ij.load_sweep, finished, error=ij.StoreError)
    with pytest.warns(UserWarning, match="3 units are damaged"):
        assert cases.table(store=finished).identical(table)
    other = tmp_path / "other.zarr"
    cases.table(store=other, seed=4)
    for source in other.rglob("c/0*"):
        target = finished / source.relative_to(other)
        if source.is_dir():
            shutil.copytree(source, target, dirs_exist_ok=True)
        else:
            shutil.copy(source, target)
    assert_refused("unit 0 is damaged", ij.load_sweep, finished, error=ij.StoreError)


def test_what_is_no_store_or_cannot_be_written_is_refused(tmp_path, finished, monkeypatch):
    (tmp_path / "file").write_text("hello")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "notes.txt").write_text("mine")
    import zarr

    zarr.create_group(str(tmp_path / "group"))
    for name in ("file", "folder", "group"):
        with pytest.raises(ij.StoreError, match=rf"{name}.*(not a store|did not write)"):
            cases.table(store=tmp_path / name)
    assert (tmp_path / "folder" / "notes.txt").read_text() == "mine"
    assert_refused("no store here", ij.load_sweep, tmp_path / "nothing", error=ij.StoreError)
    with pytest.raises(ij.StoreError, match="cannot be written"):
        cases.table(store=tmp_path / "file" / "sweep.zarr")
    if os.getuid() == 0:
        plain = os.access
        monkeypatch.setattr(
            store.os, "access", lambda path, mode: Path(path) != finished and plain(path, mode)
        )
    else:
        finished.chmod(0o500)
    with pytest.raises(ij.StoreError, match=r"cannot be written \(Permission denied\)"):
        cases.table(store=finished)
    monkeypatch.setitem(sys.modules, "zarr", None)
    assert_refused(r"\.\[sweep\]", cases.table, store=tmp_path / "sweep.zarr", error=ij.StoreError)


class Payload:
    """What is unpickled makes a file."""

    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return Path.touch, (self.marker,)


def crafted(path, marker, kind):
    """A store, written by hand, in which the chunks of `margin` are unpickled."""
    attributes = {"iblf_jax_store": 1, "config": {}, "cases": 1, "unit": 1, "variables": ["margin"]}
    array = {"zarr_format": 2, "shape": [1], "chunks": [1], "fill_value": 0, "order": "C"}
    array |= {"compressor": None, "filters": None}
    done = array | {"dtype": "<u8", "fill_value": 1}
    array |= {"dtype": "|O", "fill_value": ""}
    array |= {"filters": [{"id": "vlen-utf8"}, {"id": "pickle"}]}
    group = {"zarr_format": 3, "node_type": "group", "attributes": attributes}
    arrays = {"margin": array, "done": done}
    inline = {"kind": "inline", "must_understand": False, "metadata": arrays}
    for folder, each in arrays.items():
        (path / folder).mkdir(parents=True)
        (path / folder / ".zarray").write_text(json.dumps(each))
    if kind == "format 2":
        (path / ".zgroup").write_text('{"zarr_format": 2}')
        (path / ".zattrs").write_text(json.dumps(attributes))
    else:
        hidden = {"consolidated_metadata": inline} if kind == "hidden in format 3" else {}
        (path / "zarr.json").write_text(json.dumps(group | hidden))
    (path / "margin" / "0").write_bytes(pickle.dumps(Payload(marker)))


KINDS = ("format 2", "hidden in format 3", "format 2 in a group of format 3")


@pytest.mark.parametrize("kind", KINDS)
def test_a_store_that_would_run_code_is_not_opened(tmp_path, monkeypatch, kind):
    """Issue 12: metadata of zarr's older format may name the codec `pickle`, which numcodecs before
    0.16.6 obeys, later where told."""
    import numcodecs.pickles
    import zarr

    monkeypatch.setattr(numcodecs.pickles, "ALLOW_UNSAFE_PICKLE_DECODE", True, raising=False)
    path, marker = tmp_path / "sweep.zarr", tmp_path / "marker"
    crafted(path, marker, kind)
    # Since 3.4 zarr has to be asked too.
    with zarr.config.set({"array.allow_unsafe_pickle_decode": True}):
        for read in (ij.load_sweep, lambda place: cases.table(store=place)):
            words = r"sweep.zarr.*(not a store|is damaged)"
            with pytest.raises(ij.StoreError, match=words) as caught:
                read(path)
            assert "\n" not in str(caught.value)
        assert not marker.exists()
        if kind != KINDS[2]:
            with contextlib.suppress(Exception):  # what comes out is no array
                zarr.open_group(str(path), mode="r")["margin"][:]
            assert marker.exists(), "this store is no danger, so the test shows nothing"


@pytest.mark.parametrize(
    "change",
    [
        lambda attributes, margin: margin.update(data_type="string", fill_value=""),
        lambda attributes, margin: margin.update(shape=[3000, 3]),
        lambda attributes, margin: margin.update(zarr_format=2),
        lambda attributes, margin: attributes.update(cases=10**15),
        lambda attributes, margin: attributes.update(unit=0),
        lambda attributes, margin: attributes.update(variables=["../../margin"]),
        lambda attributes, margin: attributes.update(variables="margin"),
        lambda attributes, margin: attributes.update(config={}),
        lambda attributes, margin: attributes.pop("config"),
        lambda attributes, margin: attributes["config"].update(dims=3),
        lambda attributes, margin: attributes["config"].update(points={"controller.K2": None}),
    ],
)
def test_a_description_that_is_wrong_is_refused(finished, change):
    files = [finished / name / "zarr.json" for name in ("", "margin")]
    group, margin = (json.loads(file.read_text()) for file in files)
    change(group["attributes"], margin)
    for file, content in zip(files, (group, margin), strict=True):
        file.write_text(json.dumps(content))
    with pytest.raises(ij.StoreError, match=r"sweep.zarr: .*damaged") as caught:
        ij.load_sweep(finished)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 600 + len(str(finished))


def test_a_full_disk_keeps_what_was_written(tmp_path, table, monkeypatch):
    import zarr

    path, plain, count = tmp_path / "sweep.zarr", zarr.Array.__setitem__, []

    def full(*words, **options):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def full_soon(self, *words):
        count.append(1)
        return (full if len(count) > 40 else plain)(self, *words)

    with monkeypatch.context() as patch:
        patch.setattr(zarr.Array, "__setitem__", full_soon)
        with pytest.raises(ij.StoreError, match=r"no space left.*units are written and valid"):
            cases.table(store=path)
    part = ij.load_sweep(path)
    assert 0 < part.attrs["computed_cases"] < part.attrs["cases"]
    assert np.array_equal(np.isnan(part.margin[..., 0]), part.status == -1)
    assert cases.table(store=path).identical(table)
    shutil.rmtree(path)
    monkeypatch.setattr(zarr, "consolidate_metadata", full)
    assert_refused("no space left", cases.table, store=path, error=store.StoreWriteError)
    assert list(tmp_path.iterdir()) == []


def cut_in(monkeypatch, count, deed):
    """Does something before the so-many-th write of an array."""
    import zarr

    plain, written = zarr.Array.__setitem__, []

    def write(self, *words):
        written.append(1)
        if len(written) == count:
            deed()
        return plain(self, *words)

    monkeypatch.setattr(zarr.Array, "__setitem__", write)


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 25])
def test_a_store_that_is_deleted_meanwhile_is_begun_anew(tmp_path, table, monkeypatch, count):
    """Noticed at the unit at hand; nothing stays that would be in the way of the same call."""
    path = tmp_path / "sweep.zarr"
    with monkeypatch.context() as patch:
        cut_in(patch, count, lambda: shutil.rmtree(path))
        words = r"was deleted while it was in use\. Start the same call again"
        assert_refused(words, cases.table, store=path, error=store.StoreWriteError)
    assert list(tmp_path.iterdir()) == []
    assert cases.table(store=path).identical(table)


def test_a_store_that_is_deleted_at_the_very_end_is_noticed(tmp_path, monkeypatch):
    path, plain = tmp_path / "sweep.zarr", store.Store.write

    def write(self, unit, data):
        plain(self, unit, data)
        if unit == 11:
            shutil.rmtree(path)

    monkeypatch.setattr(store.Store, "write", write)
    assert_refused("was deleted", cases.table, store=path, error=store.StoreWriteError)


@pytest.mark.parametrize("words", ["lost arrays", "was replaced"])
def test_a_store_that_is_changed_is_not_written_on(tmp_path, finished, monkeypatch, words):
    path = tmp_path / "new" / "sweep.zarr"

    def deed():
        if words == "lost arrays":
            shutil.rmtree(path / "margin")
        else:
            shutil.rmtree(path)
            shutil.copytree(finished, path)
            settings = json.loads((path / "zarr.json").read_text())
            settings["attributes"]["config"]["seed"] = 4
            (path / "zarr.json").write_text(json.dumps(settings))

    cut_in(monkeypatch, 9, deed)
    assert_refused(words, cases.table, store=path, error=store.StoreWriteError)


KILLED_CREATION = """
import os, signal, sys; from pathlib import Path; from iblf_jax.studies import store
os.rename = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
variables = {"x": store.Variable((2,), "float64", ("joint",), "rad")}
store.open_store(Path(sys.argv[1]), {}, variables, 4, 2)
"""


@pytest.mark.slow
def test_the_draft_of_a_killed_creation_is_removed_by_the_next(tmp_path, table):
    """At once, not after an hour; the store's name may hold the signs of a pattern."""
    path = tmp_path / "sweep[1].zarr"
    process = cases.start_python(tmp_path / "compiled", "-c", KILLED_CREATION, str(path))
    process.communicate(timeout=300)
    assert process.returncode == -signal.SIGKILL
    (left,) = tmp_path.iterdir()
    assert left.name.endswith(".partial") and (left / "store" / "x").is_dir()
    assert cases.table(store=path).identical(table) and list(tmp_path.iterdir()) == [path]


@pytest.mark.slow
@pytest.mark.parametrize("kills", [4, pytest.param(20, marks=pytest.mark.release)])
def test_many_kills(tmp_path, compiled, table, kills):
    """At random moments; then the sweep may finish."""
    rng, path = random.Random(kills), tmp_path / "sweep.zarr"
    out, errors = tmp_path / "out.npz", tmp_path / "errors.txt"
    with cases.Forks(compiled, errors) as forks:
        for count in range(kills):
            process = forks.start(str(out), "--store", str(path), "--slow", "0.15")
            # Every second time, not before a unit is written.
            first = forks.line() if count % 2 else ""
            assert not first.startswith("ended"), errors.read_text()
            time.sleep(rng.uniform(0.0, 1.0 if first else 4.0))
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
            code = forks.ended()
            assert code in (0, -signal.SIGKILL), errors.read_text()
            if code == 0:
                shutil.rmtree(path)
    process = cases.start(compiled, str(out), "--store", str(path))
    _, said = process.communicate(timeout=300)
    assert process.returncode == 0, said
    assert cases.same(dict(np.load(out)), cases.arrays(table))


@pytest.mark.slow
def test_killed_after_a_unit_only_the_rest_is_computed(tmp_path, compiled, table):
    path, out = tmp_path / "sweep.zarr", tmp_path / "x.npz"
    process = cases.start(compiled, str(out), "--store", str(path), "--die-after", "5")
    process.communicate(timeout=300)
    assert process.returncode == -signal.SIGKILL
    assert ij.load_sweep(path).attrs["computed_cases"] == 5 * cases.UNIT
    computed, plain = [], store.Store.write

    def write(self, unit, data):
        computed.append(unit)
        plain(self, unit, data)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(store.Store, "write", write)
        assert cases.table(store=path).identical(table)
    assert computed == list(range(5, 12))


@pytest.mark.slow
@pytest.mark.parametrize("word", ["Ctrl-C", "SIGTERM"])
def test_a_signal_stops_after_the_unit(tmp_path, table, monkeypatch, capsys, word):
    path, plain = tmp_path / "sweep.zarr", store.Store.write

    def write(self, unit, data):
        if unit == 2:
            os.kill(os.getpid(), signal.SIGINT if word == "Ctrl-C" else signal.SIGTERM)
        plain(self, unit, data)

    monkeypatch.setattr(store.Store, "write", write)
    with pytest.raises(interrupt.Interrupted, match=r"after 3 of 12 units.*Start the same call"):
        cases.table(store=path)
    assert word in capsys.readouterr().err
    monkeypatch.undo()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    assert cases.table(store=path).identical(table)


@pytest.mark.parametrize("event", range(40))
def test_handlers_are_given_back_wherever_a_second_signal_comes(event, monkeypatch):
    """Ctrl-C twice at any line of __enter__ and __exit__, which then do not come to their end."""
    monkeypatch.setattr(sys, "stderr", None)
    before = {number: signal.getsignal(number) for number in interrupt.STOP_SIGNALS}
    files, seen = interrupt.StopRequest.__enter__.__code__.co_filename, 0

    def trace(frame, what, value):
        nonlocal seen
        if frame.f_code.co_filename != files:
            return None
        seen += 1
        if seen == event + 1:
            sys.settrace(None)
            for _ in range(2):
                signal.raise_signal(signal.SIGINT)
        return trace

    old = sys.gettrace()
    sys.settrace(trace)
    try:
        with contextlib.suppress(KeyboardInterrupt), interrupt.StopRequest():
            pass
        assert {number: signal.getsignal(number) for number in before} == before
    finally:
        sys.settrace(old)
        for number, handler in before.items():
            signal.signal(number, handler)
