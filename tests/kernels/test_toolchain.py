"""The compiler and the cache of kernels: whatever is wrong, a kernel is right or is not there."""

import contextlib
import json
import os
import random
import shutil
import signal
import stat
import subprocess
import sys
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import jaxlib
import numpy as np
import pytest
from conftest import ROOT
from fallback import with_fallback
from jax.experimental.compilation_cache.compilation_cache import reset_cache
from refused import assert_refused

from iblf_jax import cli
from iblf_jax.core import devices
from iblf_jax.core.caches import CACHE
from iblf_jax.core.disk_cache import _reloads_badly, keep_programs
from iblf_jax.engine import compile, native
from iblf_jax.kernels import directory, drafts, nvrtc, processor, toolchain
from iblf_jax.kernels.toolchain import ToolchainError

SOURCE = 'extern "C" __attribute__((visibility("default"))) int value(void) { return 41; }'
OTHER = SOURCE.replace("41", "42")
ZIG_CACHE = os.environ.get("ZIG_GLOBAL_CACHE_DIR") or str(Path.home() / ".cache" / "zig")
"""Where ziglang keeps its own libraries for all tests; to make them takes it four seconds."""
needs_compiler = pytest.mark.skipif(native.unavailable() is not None, reason="no C++ compiler")


def value(source=SOURCE):
    return toolchain.loaded(toolchain.built(source)[0], "value").value()


@pytest.fixture(scope="module")
def filled(tmp_path_factory):
    """A cache with two kernels, to be copied, and the name of the first."""
    folder = tmp_path_factory.mktemp("filled")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder))
        patch.setattr(toolchain.CACHES, "libraries", {})
        assert [value(), value(OTHER)] == [41, 42]
        return folder, toolchain.built(SOURCE)[0].name


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(toolchain.CACHES, "libraries", {})  # as in another process
    return tmp_path / "cache" / "iblf_jax"


@pytest.fixture
def library(filled, cache):
    shutil.copytree(filled[0], cache.parent)
    return cache / filled[1]


def flipped(data: bytes, bit: int) -> bytes:
    changed = bytearray(data)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


def damages():
    """Ways in which a file comes to hold something else: functions of the folder and the file."""
    draw = random.Random(0)

    def rewritten(change):
        return lambda _, f: f.write_bytes(change(f.read_bytes()))

    def cut(share):
        return rewritten(lambda x: x[: int(share * len(x)) if share >= 0 else -1])

    def flip(share):
        return rewritten(lambda x: flipped(x, int(share * 8 * len(x))))

    def copied(of):
        return lambda folder, f: shutil.copy(of(folder, f), f)

    ways = {f"cut at {x:.3f}": cut(x) for x in (0.0, draw.random(), -1.0)}
    ways |= {f"bit at {x:.3f}": flip(x) for x in (draw.random(), draw.random(), draw.random())}
    return ways | {
        "text": rewritten(lambda _: b"this is no library\n"),
        "longer": rewritten(lambda x: x + b"\0"),
        "zeros": rewritten(lambda x: bytes(len(x))),
        "another kernel": copied(lambda folder, f: next(x for x in folder.iterdir() if x != f)),
        "another library": copied(lambda *_: Path(jaxlib.__file__).parent / "_jax.so"),
        "a folder": lambda _, f: (f.unlink(), f.mkdir(), (f / "x").write_text("")),
        "a pipe": lambda _, f: (f.unlink(), os.mkfifo(f)),
        "gone": lambda _, f: f.unlink(),
        "writable by others": lambda _, f: f.chmod(0o722),
    }


DAMAGES = damages()


@needs_compiler
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_kernel_is_built_again(library, damage):
    """Never loaded: truncated it kills, with one bit flipped it may return anything."""
    DAMAGES[damage](library.parent, library)
    assert toolchain._checked(library) is None, "the damage is seen"
    assert value() == 41 and toolchain._checked(library) is not None
    assert [x.suffix for x in library.parent.iterdir()] == [".so", ".so"], "nothing temporary stays"
    assert stat.S_IMODE(library.stat().st_mode) == 0o700


@needs_compiler
def test_a_whole_kernel_is_not_built_again_and_what_was_checked_is_loaded(library, monkeypatch):
    """A file that is damaged before the load is not loaded, and after it does no harm."""
    monkeypatch.setattr(toolchain, "draft", lambda *_: pytest.fail("built again"))
    assert [value(), value(OTHER)] == [41, 42]
    toolchain.CACHES.libraries.clear()
    loaded = toolchain.loaded(library, "value")
    with open(library, "r+b") as file:
        file.truncate(100)  # a library that was mapped from this file would now kill with SIGBUS
    assert loaded.value() == 41 and toolchain.loaded(library) is loaded
    toolchain.CACHES.libraries.clear()
    assert_refused("damaged", toolchain.loaded, library, error=ToolchainError)


def test_machine_code_of_gpus_is_checked_too(cache, monkeypatch):
    monkeypatch.setattr(nvrtc, "version", lambda: "13.0")
    monkeypatch.setattr(nvrtc, "_compile", lambda source, flags: b"machine code")
    for _ in range(2):
        assert nvrtc.compiled("source", "sm_90") == b"machine code"
        (file,) = cache.iterdir()
        file.write_bytes(flipped(file.read_bytes(), 5))


@needs_compiler
def test_links_in_the_cache_are_not_followed(library, tmp_path):
    """Neither one in a kernel's place nor one that poses as a draft."""
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    library.rename(elsewhere / "file").chmod(0o640)
    library.symlink_to(elsewhere / "file")
    for name in (".kernel.planted.partial", "tmp12345678"):
        (library.parent / name).symlink_to(elsewhere)
        os.utime(library.parent / name, (0, 0), follow_symlinks=False)
    assert value() == 41 and not library.is_symlink()
    assert stat.S_IMODE((elsewhere / "file").stat().st_mode) == 0o640
    assert [x.name for x in elsewhere.iterdir()] == ["file"]


@pytest.mark.parametrize("link", ["symbolic", "hard", "to a folder"])
def test_a_compiler_that_leaves_a_link(cache, tmp_path, monkeypatch, link):
    """Issue 12: the mode of the file that it points to was changed."""
    target = tmp_path / "precious"
    target.mkdir() if link == "to a folder" else target.write_text("precious")
    target.chmod(0o750)
    words = "ln" if link == "hard" else "ln -s"
    fake(tmp_path, monkeypatch, compiles(f'{words} {target} "$out"; exit 0'))
    with pytest.raises(ToolchainError):
        value()
    assert stat.S_IMODE(target.lstat().st_mode) == 0o750
    assert target.is_dir() or target.read_text() == "precious"


def chosen_cache(monkeypatch, badly=False):
    """Where the command line keeps JAX's compiled programs, and what it says."""
    seen, said = {}, []
    monkeypatch.setattr(jax.config, "update", seen.__setitem__)
    monkeypatch.setattr(type(jax.config), "jax_compilation_cache_dir", None, raising=False)
    monkeypatch.setattr(type(jax.config), "jax_enable_compilation_cache", True, raising=False)
    monkeypatch.setattr(warnings, "warn", lambda text, *_, **__: said.append(text))
    monkeypatch.setattr("iblf_jax.core.disk_cache._reloads_badly", lambda: badly)
    keep_programs.cache_clear()
    cli.prepare_jax()
    return seen.get("jax_compilation_cache_dir"), said


def test_programs_of_jax_get_the_check_of_the_kernels(cache, tmp_path, monkeypatch):
    cache.mkdir(parents=True)
    cache.chmod(0o777)
    found, said = chosen_cache(monkeypatch)
    assert (Path(found).parent, said) == (cache, [])
    assert stat.S_IMODE(cache.stat().st_mode) == 0o700
    (cache / "jit_run-cache").symlink_to(tmp_path)
    found, (said,) = chosen_cache(monkeypatch)
    assert found is None and "jit_run-cache" in said
    shutil.rmtree(cache)
    (tmp_path / "elsewhere").mkdir(mode=0o755)
    cache.symlink_to(tmp_path / "elsewhere")
    assert chosen_cache(monkeypatch)[0] is None
    assert stat.S_IMODE((tmp_path / "elsewhere").stat().st_mode) == 0o755


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give files away")
def test_files_and_folders_of_others_are_not_used(cache, monkeypatch):
    cache.mkdir(parents=True)
    (cache / "jit_run-cache").write_text("code of another user")
    os.chown(cache / "jit_run-cache", 12345, 12345)
    assert chosen_cache(monkeypatch)[0] is None
    (cache / "jit_run-cache").unlink()
    os.chown(cache, 12345, 12345)
    assert chosen_cache(monkeypatch)[0] is None
    assert_refused("not a directory of this user", directory, error=OSError)


def made(path, days):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(bytes(1000))
    os.utime(path, (time.time() - days * 24 * 3600.0,) * 2)
    return path


def test_what_was_used_longest_ago_goes_first(cache, tmp_path, monkeypatch):
    """Foreign files stay, and so does what is about to be loaded, and what is behind a link."""
    days = {"a.so": 9, "xla-abc/b-cache": 7, "c.so": 5, "d.so": 1e-3, "notes.txt": 99}
    for name, age in days.items():
        made(cache / name, age)
    for size, left in ((2500, ["c.so", "d.so", "notes.txt"]), (0, ["d.so", "notes.txt"])):
        monkeypatch.setattr("iblf_jax.core.disk_cache.MAX_BYTES", size)
        chosen_cache(monkeypatch)
        assert sorted(path.name for path in cache.rglob("*") if path.is_file()) == left
    precious = made(tmp_path / "elsewhere" / "precious.so", 1e4)
    (cache / "xla-old").symlink_to(tmp_path / "elsewhere")
    assert chosen_cache(monkeypatch)[0] is None and precious.exists()


def test_programs_of_another_processor_are_apart(cache, monkeypatch):
    """Also in a home that machines share; where XLA refuses its own, nothing is kept."""
    folders = set()
    for flags in ("sse avx", "sse avx avx512f"):
        lines = ["model name : Same 9000", f"flags : {flags}"]
        monkeypatch.setattr("iblf_jax.kernels.folder.cpuinfo", lambda lines=lines: lines)
        processor.cache_clear()
        folders.add(chosen_cache(monkeypatch)[0])
    processor.cache_clear()
    assert len(folders - {None}) == 2
    lines = ["model name : Same 9000", "bugs : spectre_v2 gds mds"]
    monkeypatch.setattr("iblf_jax.core.disk_cache.cpuinfo", lambda: lines)
    assert chosen_cache(monkeypatch, badly=_reloads_badly()) == (None, [])


OPTIONS = [
    *("jax_compilation_cache_dir", "jax_enable_compilation_cache"),
    *("jax_persistent_cache_min_compile_time_secs", "jax_persistent_cache_min_entry_size_bytes"),
]


def keep_programs_as_told(folder, enabled):
    jax.config.update("jax_compilation_cache_dir", folder)
    jax.config.update("jax_enable_compilation_cache", enabled)
    keep_programs.cache_clear()
    keep_programs()


@pytest.fixture
def programs(cache):
    """The folder in which JAX keeps what it compiles, as in a user's process."""
    before = {name: getattr(jax.config, name) for name in OPTIONS}
    keep_programs_as_told(None, True)
    yield Path(jax.config.jax_compilation_cache_dir)
    for name, x in before.items():
        jax.config.update(name, x)
    reset_cache()
    keep_programs.cache_clear()


def values_of_programs():
    """What three new programs give; two of them take the same arguments."""
    x = np.arange(3.0)
    programs = (lambda x, y: x + y, lambda x, y: x * y, lambda x: x - 4.0)
    arguments = ((x, 2.0), (x, 5.0), (x,))
    return [float(jax.jit(f)(*given)[1]) for f, given in zip(programs, arguments, strict=True)]


@contextlib.contextmanager
def at_most(seconds):
    """Fails if what is done takes longer, even if it waits for ever."""
    before = signal.signal(signal.SIGALRM, lambda *_: pytest.fail(f"took longer than {seconds} s"))
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


@pytest.mark.skipif(_reloads_badly(), reason="XLA refuses its own programs on this processor")
@pytest.mark.parametrize(
    "damage", ["none", "swapped", "a pipe", "a folder", "text", "cut at -1.000", "longer", "zeros"]
)
def test_a_damaged_program_of_jax_is_compiled_again(programs, damage):
    """A sound one, and what was compiled again, is used; a swapped one has another's numbers."""

    def times():
        return [entry.lstat().st_mtime_ns for entry in entries]

    expected = values_of_programs()
    entries = sorted(programs.glob("*-cache"))
    before, whole = times(), [entry.read_bytes() for entry in entries]
    assert len(entries) >= 3
    if damage == "swapped":
        for entry, content in zip(entries, whole[1:] + whole[:1], strict=True):
            entry.write_bytes(content)
    for entry in entries if damage in DAMAGES else ():
        DAMAGES[damage](programs, entry)
    with at_most(20), warnings.catch_warnings(action="error"):
        assert values_of_programs() == expected
        made = times()
        assert values_of_programs() == expected
    assert times() == made, "what was compiled again is kept"
    assert damage != "none" or made == before


def until(condition) -> bool:
    return any(condition() or time.sleep(0.01) for _ in range(2000))


def wait_for(path):
    assert until(lambda: path.exists() and path.read_text().strip())


def wait_for_compiler(calls):
    """Until the compiler has written a file, and this process knows its number."""
    wait_for(calls)
    assert until(lambda: toolchain.CACHES.running)


def has_ended(pid: Path) -> bool:
    state = Path(f"/proc/{pid.read_text().strip()}/stat")

    def ended():
        try:
            return "Z" in state.read_text().rpartition(")")[2]
        except (FileNotFoundError, ProcessLookupError):
            return True

    return until(ended)


@pytest.fixture
def slow_compiler(cache, tmp_path, monkeypatch):
    """A compiler that works for a while; what it has written is where its calls are."""
    calls = tmp_path / "calls"
    fake(tmp_path, monkeypatch, compiles(f'echo once >> {calls}; sleep 0.5; exec "$REAL" "$@"'))
    return calls


@needs_compiler
def test_what_is_built_ahead_is_built_once(slow_compiler, tmp_path, monkeypatch):
    """Who wants it meanwhile waits for it, and is told once what went wrong."""
    calls = slow_compiler
    toolchain.build_ahead(SOURCE)
    wait_for(calls)
    assert value() == 41 and calls.read_text().split() == ["once"]
    calls.unlink()
    broken = compiles(f"echo once >> {calls}; sleep 0.2; echo error: no >&2; exit 1")
    fake(tmp_path, monkeypatch, broken)
    toolchain.build_ahead(OTHER)
    wait_for(calls)
    for tries in (1, 2):
        assert_refused("error: no", toolchain.built, OTHER, error=ToolchainError)
        assert len(calls.read_text().split()) == tries


@needs_compiler
def test_who_stops_waiting_stops_the_compiler(cache, tmp_path, monkeypatch):
    """Ctrl-C while another thread's compiler runs; it is built when it is asked for again."""
    pid = tmp_path / "pid"
    fake(tmp_path, monkeypatch, compiles(f"echo $$ > {pid}; exec sleep 60"))
    toolchain.build_ahead(SOURCE)
    wait_for(pid)
    signal.signal(signal.SIGALRM, lambda *_: signal.raise_signal(signal.SIGINT))
    signal.setitimer(signal.ITIMER_REAL, 0.2)
    with pytest.raises(KeyboardInterrupt):
        toolchain.built(SOURCE)
    assert has_ended(pid)
    fake(tmp_path, monkeypatch, compiles('exec "$REAL" "$@"'))
    assert value() == 41


@needs_compiler
def test_a_compiler_of_another_thread_is_left_and_who_waits_for_a_stopped_one_builds(slow_compiler):
    """An exception in one thread is no reason to end the build of another one."""
    with ThreadPoolExecutor(1) as other:
        found = other.submit(toolchain.built, SOURCE)
        wait_for_compiler(slow_compiler)
        with pytest.raises(ZeroDivisionError), compile.building():
            raise ZeroDivisionError
        found.result()
        assert slow_compiler.read_text().split() == ["once"]
        slow_compiler.unlink()
        toolchain.build_ahead(OTHER)
        wait_for_compiler(slow_compiler)
        found = other.submit(toolchain.built, OTHER)
        toolchain.stop_own_compilers()
        found.result()
    assert slow_compiler.read_text().split() == ["once"] * 2


def test_a_stopped_compiler_is_asked_again_for_its_version(tmp_path, monkeypatch):
    fake(tmp_path, monkeypatch, "echo fake 1.0")
    command = toolchain.compiler()

    def stopped(*arguments):
        raise toolchain.StoppedError("the compiler was stopped")

    with monkeypatch.context() as patch:
        patch.setattr(toolchain, "_run", stopped)
        with pytest.raises(toolchain.StoppedError):
            toolchain._version(command)
    assert toolchain._version(command).line == "fake 1.0"


FRESH = """
import jax
events = []
jax.monitoring.register_event_listener(lambda name, **_: events.append(name))
import jax.numpy as jnp
jnp.ones(3) + 1.0  # something of the user's that JAX has compiled before
import iblf_jax as ij
print(repr(jax.config.jax_compilation_cache_dir), end=" ")
ij.simulate(ij.presets.zhang_yan_2024(), duration=0.05, dt=1e-3)
counts = [sum(e.endswith(x) for e in events) for x in ("cache_hits", "cache_misses")]
print(repr(jax.config.jax_compilation_cache_dir), counts)
"""


@pytest.mark.slow
@pytest.mark.skipif(_reloads_badly(), reason="XLA refuses its own programs on this processor")
def test_a_script_keeps_its_programs_without_being_told(tmp_path):
    """Not at the import, but from the first run on; a second process compiles nothing of it."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    environment |= {"XDG_CACHE_HOME": str(tmp_path), "PYTHONPATH": str(ROOT)}
    for again in (False, True):
        printed = subprocess.check_output(
            [sys.executable, "-c", FRESH], env=environment, text=True, timeout=250
        )
        before, after, counts = printed.split(" ", 2)
        assert before == "None" and Path(after.strip("'")).parent == tmp_path / "iblf_jax"
        hits, misses = json.loads(counts)
        assert (misses == 0 < hits) if again else (misses > hits)


@pytest.mark.parametrize(("folder", "enabled"), [("own", True), (None, False)])
def test_who_told_jax_is_obeyed(programs, folder, enabled):
    keep_programs_as_told(folder, enabled)
    assert jax.config.jax_compilation_cache_dir == folder


def nothing_fits(number):
    """A disk on which a folder can be entered and nothing made."""
    plain = Path.mkdir

    def mkdir(self, *words, **more):
        if self.parent.name == "iblf_jax":
            raise OSError(number, os.strerror(number), str(self))
        plain(self, *words, **more)

    def prepare(base, monkeypatch):
        (base / "iblf_jax").mkdir(mode=0o700, parents=True)
        monkeypatch.setattr(Path, "mkdir", mkdir)

    return prepare


def no_room(*_):
    raise OSError(28, os.strerror(28))


def without_home(_, patch):
    def no_home():
        raise RuntimeError("Could not determine home directory.")

    patch.delenv("XDG_CACHE_HOME")
    patch.setattr(Path, "home", no_home)


UNUSABLE = {
    "a file in its place": lambda base, _: (base.mkdir(), (base / "iblf_jax").write_text("")),
    "a link in its place": lambda base, _: (base.mkdir(), (base / "iblf_jax").symlink_to(base)),
    "under a file": lambda base, _: base.write_text(""),
    "in /proc": lambda _, patch: patch.setenv("XDG_CACHE_HOME", "/proc/self/nothing"),
    "no home": without_home,
    "a name too long": lambda base, patch: patch.setenv("XDG_CACHE_HOME", f"{base}/{'x' * 300}"),
    "read-only": nothing_fits(30),
    "no inodes": nothing_fits(28),
    "full at the last write": lambda _, patch: patch.setattr(os, "fsync", no_room),
}


@needs_compiler
@pytest.mark.parametrize("way", UNUSABLE)
def test_an_unusable_cache_is_one_line_and_vmap(tmp_path, monkeypatch, way):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "base"))
    UNUSABLE[way](tmp_path / "base", monkeypatch)
    assert falls_back(lambda: toolchain.built(SOURCE)).startswith(
        "The native backend is not available (the cache "
    )
    chosen_cache(monkeypatch)


def falls_back(work):
    """The one line with which `work`, on the native backend, ends up on vmap."""

    def run_on(name):
        work()
        return name

    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        CACHE.clear(compile.WARNINGS)
        assert with_fallback("native", run_on, lambda: "vmap") == "vmap"
    (line,) = [str(x.message) for x in said]
    assert line.endswith("running on vmap.") and "\n" not in line
    return line


def fake(folder, monkeypatch, script):
    """Puts a shell script in the compiler's place; $REAL is the real one."""
    path = folder / "fake-compiler"
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)
    monkeypatch.setenv("REAL", shutil.which("c++") or shutil.which("g++") or "")
    monkeypatch.setenv("CXX", str(path))


def compiles(script: str, version: str = "echo fake 1.0") -> str:
    """A compiler that says its version and else does what `script` does, into the file $out."""
    words = 'for o; do [ "$p" = -o ] && out=$o; p=$o; done'
    return f'[ "$1" = --version ] && {{ {version}; exit 0; }}\n{words}\n{script}'


def ziglang_script(folder: Path) -> str:
    path = folder / "zig-c++"
    path.write_text(f'#!/bin/sh\nexec {sys.executable} -m ziglang c++ "$@"\n')
    path.chmod(0o755)
    return str(path)


VERSIONS = {
    "c++ (Debian 12.2.0-14) 12.2.0\nCopyright (C) 2022 Free Software Foundation, Inc.": "gcc",
    "clang-less (GCC) 14.1\nCopyright (C) 2024 Free Software Foundation, Inc.": "gcc",
    "Debian clang version 14.0.6\nTarget: x86_64-pc-linux-gnu\nInstalledDir: /usr/bin": "clang",
    "Apple clang version 15.0.0 (clang-1500.3.9.4)\nTarget: arm64-apple-darwin23": "clang",
    "Intel(R) oneAPI DPC++/C++ Compiler 2024.0\nInstalledDir: /opt/intel/bin": "clang",
    "\n  a wrapper 1.0\n": "other",
}


@pytest.mark.parametrize("text", VERSIONS)
def test_the_flags_follow_the_kind_of_compiler(text):
    version, kind = toolchain.Version.of(text), VERSIONS[text]
    assert (version.line, version.kind) == (text.strip().splitlines()[0], kind)
    flags = toolchain.flags_of(kind)
    assert ("-fcaller-saves" in flags) == (kind == "gcc")
    assert ("-fslp-vectorize" in flags) == (kind == "clang")


@pytest.mark.parametrize(
    ("machine", "kind", "flag"),
    [("arm64", "clang", "-mcpu"), ("aarch64", "gcc", "-march"), ("x86_64", "clang", "-march")],
)
def test_the_flag_of_the_processor(monkeypatch, machine, kind, flag):
    monkeypatch.setattr(toolchain.platform, "machine", lambda: machine)
    assert f"{flag}=native" in toolchain.flags_of(kind)


@needs_compiler
def test_a_compiler_is_identified_once(cache, tmp_path, monkeypatch):
    """Not at the import; again where another program has taken its place."""
    script = compiles('exec "$REAL" "$@"', f"echo once >> {tmp_path}/calls; echo fake 1.0")
    for _ in range(2):
        fake(tmp_path, monkeypatch, script)
        os.utime(os.environ["CXX"], ns=(len(os.listdir(tmp_path)),) * 2)
        assert [value(), value(OTHER)] == [41, 42]
    assert (tmp_path / "calls").read_text().split() == ["once", "once"]


@needs_compiler
def test_the_first_arguments_of_a_compiler(cache, tmp_path, monkeypatch):
    """$CXX may be a program and its first arguments, as `make` takes it."""
    calls = tmp_path / "calls"
    fake(tmp_path, monkeypatch, f'echo "$1" >> {calls}; shift; exec "$REAL" "$@"')
    monkeypatch.setenv("CXX", f"'{os.environ['CXX']}' c++")
    assert value() == 41 and set(calls.read_text().split()) == {"c++"}
    for wrong in ("no-such-compiler c++", "'open", " "):
        monkeypatch.setenv("CXX", wrong)
        with pytest.raises(ToolchainError, match=r"there is no C\+\+ compiler .*CXX"):
            toolchain.compiler()


@pytest.mark.slow
def test_ziglang_where_the_system_has_no_compiler(cache, tmp_path, monkeypatch):
    """With the wheel there is a compiler, without it the message names the wheel."""
    pytest.importorskip("ziglang")
    monkeypatch.setenv("ZIG_GLOBAL_CACHE_DIR", ZIG_CACHE)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CXX", raising=False)
    assert native.unavailable() is None
    assert value() == 41
    monkeypatch.setattr(toolchain.importlib.util, "find_spec", lambda name: None)
    assert 'pip install "iblf_jax[export]"' in native.unavailable()


COMPILERS = {
    "says no version": (compiles('"$REAL" "$@"', ":"), "prints nothing"),
    "says empty lines": (compiles('"$REAL" "$@"', "echo; echo"), "prints nothing"),
    "says bytes": (compiles('"$REAL" "$@"', r"printf '\377\376\200'"), "no text"),
    "fails with bytes": (compiles(r"printf 'error: \377\376\n' >&2; exit 1"), "failed: error"),
    "is killed": (compiles("kill -9 $$"), "signal 9"),
    "makes nothing": (compiles("exit 0"), "left no file"),
    "makes an empty file": (compiles(': > "$out"'), "left no file"),
    "makes a pipe": (compiles('mkfifo "$out"'), "left no file"),
    "makes text": (compiles('echo hello > "$out"'), "does not load"),
    "lacks the symbol": (
        compiles('echo "int x;" | "$REAL" -x c++ -shared -fPIC - -o "$out"'),
        "undefined symbol",
    ),
    "says very much": (compiles("yes error >&2; exit 1"), "failed: error"),
    "hangs": (compiles("sleep 100"), "longer than 0.5 s"),
    "hangs in a child": (compiles("sleep 100 | cat"), "longer than 0.5 s"),
    "hangs at its version": (compiles("exit 0", "sleep 100"), "longer than 0.5 s"),
    "removes its folder": (compiles('rm -r "$(dirname "$out")"'), "left no file"),
    "is no program": ("\0\1\2", ""),
}


@needs_compiler
@pytest.mark.parametrize("what", COMPILERS)
def test_a_broken_compiler_is_one_line_and_vmap(cache, tmp_path, monkeypatch, what):
    script, words = COMPILERS[what]
    fake(tmp_path, monkeypatch, script)
    if "hangs" in what:
        monkeypatch.setattr(toolchain, "TIMEOUT", 0.5)
        monkeypatch.setattr(toolchain, "VERSION_TIMEOUT", 0.5)
    assert words in falls_back(value)
    assert not cache.exists() or list(cache.iterdir()) == [], "nothing is left in the cache"
    monkeypatch.delenv("CXX")
    assert value() == 41


@needs_compiler
def test_a_compiler_that_hangs_takes_its_children_along(cache, tmp_path, monkeypatch):
    fake(tmp_path, monkeypatch, compiles(f"sh -c 'echo $$ > {tmp_path}/pid; exec sleep 100'"))
    monkeypatch.setattr(toolchain, "TIMEOUT", 0.5)
    assert_refused("longer", value, error=ToolchainError)
    assert has_ended(tmp_path / "pid")


BUILD = (
    "import sys; from iblf_jax.kernels import toolchain as t;"
    " print(t.loaded(t.built(sys.argv[1])[0]).value())"
)


def drafts_in(folder):
    return list(folder.glob(".*.partial"))


@pytest.mark.slow
@needs_compiler
def test_two_processes_build_at_once_and_one_is_killed(cache, tmp_path, monkeypatch):
    """Both get the kernel; of a third that is killed while it compiles nothing stays."""
    fake(tmp_path, monkeypatch, compiles(f': > {tmp_path}/begun; sleep 0.5; "$REAL" "$@"'))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    command = [sys.executable, "-c", BUILD, SOURCE]
    killed = subprocess.Popen(command)
    assert until((tmp_path / "begun").exists) and drafts_in(cache)
    killed.kill()
    killed.wait()
    monkeypatch.delenv("CXX")
    both = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    assert [process.communicate(timeout=60)[0] for process in both] == ["41\n", "41\n"]
    assert [x.suffix for x in cache.iterdir()] == [".so"]


HOLD = """
import importlib.util, pathlib, sys, time
spec = importlib.util.spec_from_file_location("drafts", sys.argv[1])
spec.loader.exec_module(drafts := importlib.util.module_from_spec(spec))
with drafts.draft(pathlib.Path(sys.argv[2]), "x"):
    print("there", flush=True)
    time.sleep(60)
"""


def test_the_draft_of_a_living_process_or_a_young_one_is_left_alone(tmp_path):
    command = [sys.executable, "-c", HOLD, drafts.__file__, str(tmp_path)]
    holder = subprocess.Popen(command, stdout=subprocess.PIPE)
    assert holder.stdout.readline() == b"there\n"
    (held,) = drafts_in(tmp_path)
    with drafts.draft(tmp_path, "x"):
        assert held.exists() and len(drafts_in(tmp_path)) == 2
    holder.kill()
    holder.communicate()
    assert held.exists()
    for name in "yx":  # one of something else, and the next one of the same
        with drafts.draft(tmp_path, name):
            assert held.exists() == (name == "y")
    assert drafts_in(tmp_path) == []
    # Those of other machines go by age.
    young, old = (tmp_path / f".x.{name}.partial" for name in ("00000000.1", "00000000.2"))
    young.mkdir()
    old.mkdir()
    os.utime(old, (1.0, 1.0))
    with drafts.draft(tmp_path, "x"):
        assert (young.exists(), old.exists()) == (True, False)


@pytest.mark.parametrize("wanted", ["9" * 5000, "257", "²", "000", "-1", "1.5", " 2"])
def test_a_number_of_threads_that_is_none_is_one_line(monkeypatch, wanted):
    monkeypatch.delenv("IBLF_JAX_THREADS", raising=False)
    usual = devices.threads()
    monkeypatch.setenv("IBLF_JAX_THREADS", wanted)
    words = "IBLF_JAX_THREADS: got .*, expected a whole number from 1 to 256"
    with pytest.warns(UserWarning, match=words) as said:
        assert devices.threads() == (256 if wanted[0] in "92" else usual)
    assert len(said) == 1 and len(str(said[0].message)) < 200
    for text, number in (("007", 7), ("256", 256)):
        monkeypatch.setenv("IBLF_JAX_THREADS", text)
        with warnings.catch_warnings(action="error"):
            assert devices.threads() == number
