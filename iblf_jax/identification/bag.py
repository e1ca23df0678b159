"""Reads rosbag2 recordings: joint states and efforts become the signals of a log.

A recording is a folder with `metadata.yaml` and files of the kind sqlite3 (`.db3`) or MCAP
(`.mcap`), or one such file.  The package `rosbags` (extra `ros`) reads it without ROS.

    t_k    stamp of the k-th joint state, relative to the origin of time [s]
    tau_k  the last effort that the recorder received before the joint state k + 1

Efforts (`std_msgs/Float64MultiArray`) have no stamps, so they are assigned to joint states by the
receive times of the recording.  A loop that answers each joint state within a period therefore has
the answer to the joint state in its row, from where on the torque is constant until the next row
(zero-order hold).  The latency between joint state and effort is a delay of the logged torque,
which `identify` estimates.  Messages that a recorder received at about the same time, in the
wrong order, are assigned by their number.  The torque is unknown before the first effort, after
the last one, and within an interval between efforts that is a gap by the rule of `Log.gap`; the
joint states in such intervals are no rows, so that the log has a gap there as well.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from iblf_jax.core import checks, notices

GAP_RATIO, GAP_QUANTILE = 3.0, 0.95
"""A time between samples of more than GAP_RATIO times the quantile GAP_QUANTILE of these times is a
gap."""
STATE_TYPE, EFFORT_TYPE = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray"
STORAGE_ENDINGS = (".db3", ".mcap")
"""Endings of the files of a recording."""
EXCHANGED = 0.25
"""Largest distance of messages that a recorder may have exchanged [intervals of joint states]."""
LONGEST_EXCHANGE = 10
"""Largest number of joint states between one with two efforts and one without."""
TIMES = ("stamp", "receive")
NANOSECONDS = 10**9
"""In a second."""
RESOLUTION = 0.5e-9
"""Half of the resolution of a stamp [s]."""
LATEST_ORIGIN = 9e9
"""Largest stamp of ROS in seconds, an int64 of nanoseconds."""
NAMES_REMEDY = (
    "ij.deployment.bag_log(path, scenario, joints=[...]) takes the names in the order of the"
    " scenario's joints."
)


class BagOptions(NamedTuple):
    """What is read of a recording; the arguments of `bag_log` of the same names."""

    joint_states: str = "joint_states"
    efforts: str | None = "efforts"
    joints: Sequence[str] | None = None
    times: str = "stamp"
    time_origin: float | None = None
    start: float = 0.0
    duration: float | None = None


class Recording(NamedTuple):
    """The joint states of a recording, N messages in the order of the scenario's joints, and its
    efforts.
    """

    stamp: np.ndarray
    """Stamps, or receive times in their place, (N,) int64 [ns]."""
    received: np.ndarray
    """Receive times, (N,) int64 [ns]."""
    q: np.ndarray
    dq: np.ndarray | None
    """None if a joint state has no velocities."""
    effort_received: np.ndarray
    """Receive times of the efforts, (M,) int64 [ns]."""
    effort: np.ndarray
    """(M, n) [N m]."""


def is_bag(path: Path) -> bool:
    """Whether a path is that of a recording: a folder, or a file of one."""
    return path.is_dir() or path.suffix.lower() in STORAGE_ENDINGS


def read_bag_log(
    path: Path, n: int, joints: Sequence[str], options: BagOptions
) -> dict[str, np.ndarray]:
    """The signals t [s], q, tau and, if all joint states have velocities, dq of a recording.

    Args:
      path: the folder of the recording, or one of its files.
      n: number of joints.
      joints: names of the scenario's joints; () for a robot without names.
      options: topics, names, times and selection.

    Raises:
      ValueError: invalid options, or a recording that is damaged or lacks what is read.
      ImportError: the extra `ros` is not installed.
    """
    checks.one_of("times", options.times, TIMES)
    checks.string("joint_states", options.joint_states, 'a topic, such as "joint_states"')
    if options.efforts is not None:
        checks.string("efforts", options.efforts, 'a topic, such as "efforts"')
    duration, time_origin = options.duration, options.time_origin
    if duration is not None:
        duration = checks.time_span("duration", duration)
    if time_origin is not None:
        time_origin = checks.number_between("time_origin", time_origin, 0.0, LATEST_ORIGIN, "s")
    start = checks.time_span("start", options.start, zero=True)
    options = options._replace(start=start, duration=duration, time_origin=time_origin)
    names = _requested_names(n, joints, options.joints)
    recording = _recording(path, names, n, options)
    index, is_known = np.arange(len(recording.q)), np.ones(len(recording.q), bool)
    if options.efforts is not None:
        index, is_known = held_efforts(recording.received, recording.effort_received)
    if not is_known.any():
        came = checks.Words("no joint state with an effort")
        remedy = "Record both topics while the law runs: ros2 bag record joint_states efforts."
        raise checks.fail(str(path), came, "efforts among the joint states", remedy)
    stamp = recording.stamp[is_known]
    origin = _origin(stamp, options.time_origin)
    found = {
        "t": (stamp - origin) / NANOSECONDS,
        "q": recording.q[is_known],
        "tau": recording.effort[index[is_known]],
    }
    if recording.dq is not None:
        found["dq"] = recording.dq[is_known]
    rows = _selected(found["t"], options.start, options.duration, path)
    found = {name: x[rows] for name, x in found.items()}
    for name, x in found.items():
        broken = ~np.isfinite(x).reshape(len(x), -1).all(axis=1)
        if not broken.any():
            continue
        first = found["t"][int(np.argmax(broken))]
        came = checks.Words(f"{int(broken.sum())} of {len(x)} rows, the first at t = {first:.9g} s")
        remedy = "Select a part of the recording with start and duration."
        raise checks.fail(f"{path}: {name} that is not finite", came, "finite numbers", remedy)
    return found


def _origin(stamp: np.ndarray, given: float | None) -> int:
    """The stamp that is t = 0 [ns]: the first one, or the given one."""
    if given is None:
        return int(stamp[0])
    origin = round(given * NANOSECONDS)
    nearest = int(stamp[np.argmin(np.abs(stamp - origin))])
    # As a float of seconds, a stamp of today is rounded to 240 ns.
    return nearest if nearest / NANOSECONDS == given else origin


def longest_interval(times: np.ndarray) -> float:
    """The longest time between two samples that is not a gap, in the unit of the times."""
    if len(times) < 2:
        return float("inf")
    return GAP_RATIO * float(np.quantile(np.diff(times), GAP_QUANTILE))


def held_efforts(received: np.ndarray, efforts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The effort of each joint state, and whether it is known (head of this module).

    Args:
      received: receive times of the joint states, (N,) [ns], in order.
      efforts: receive times of the efforts, (M,) [ns], in order.

    Returns:
      (N,) indices of efforts, and (N,) bool.
    """
    if not len(efforts) or not len(received):
        return np.zeros(len(received), int), np.zeros(len(received), bool)
    # The last effort from a joint state on until the next one answers it; -1 where there is none.
    end, tolerance = np.inf, 0.0
    if len(received) > 1:
        interval = float(np.median(np.diff(received)))
        end, tolerance = received[-1] + interval, EXCHANGED * interval
    first = np.searchsorted(efforts, received, side="left")
    last = np.searchsorted(efforts, np.append(received[1:], end), side="left") - 1
    order = _Order(received, efforts, tolerance, first, last)
    several = np.flatnonzero(last > first)
    if 2 * len(several) > len(received):
        several = several[:0]  # the loop has several efforts for each joint state
    for k in several.tolist():
        while order.last[k] > order.first[k] and order.repair(k):
            pass
    answer = np.where(order.last >= order.first, order.last, -1)
    is_answered = answer >= 0
    index = np.maximum.accumulate(answer)
    # Efforts before the first joint state are those of rows until the first answer.
    before = np.searchsorted(efforts, received[0], side="left") - 1
    index = np.maximum(index, before)
    is_before_gap = np.append(np.diff(efforts) > longest_interval(efforts), True)
    is_known = (index >= 0) & (is_answered | ~is_before_gap[index])
    return np.maximum(index, 0), is_known


class _Order(NamedTuple):
    """The efforts of each joint state, from which messages are moved that a recorder exchanged.

    A recorder may exchange a joint state and an effort that arrive at about the same time.  Then
    one joint state has two efforts, and another one near it has none.  The efforts between the two
    are moved by one joint state if all of them were received close to their new ones.
    """

    received: np.ndarray
    efforts: np.ndarray
    tolerance: float
    """Largest distance of messages that were exchanged [ns]."""
    first: np.ndarray
    """Index of the first effort of each joint state, (N,)."""
    last: np.ndarray
    """Index of the last effort, before the first one where there is none, (N,)."""

    def repair(self, k: int) -> bool:
        """Moves an effort of the joint state k, which has several; whether this was possible."""
        backward, forward = self._backward(k), self._forward(k)
        if backward and (not forward or backward <= forward):
            self.first[k] += 1
            self.first[k - backward : k] += 1
            self.last[k - backward : k] += 1
            self.first[k - backward] = self.last[k - backward] = self.first[k] - backward
            return True
        if forward:
            self.last[k] -= 1
            self.first[k + 1 : k + forward + 1] -= 1
            self.last[k + 1 : k + forward + 1] -= 1
            self.first[k + forward] = self.last[k + forward] = self.last[k] + forward
            return True
        return False

    def _backward(self, k: int) -> int:
        """The distance of the joint state before k that has no effort; 0 if there is none."""
        for distance in range(1, min(LONGEST_EXCHANGE, k) + 1):
            row = k - distance
            if self.efforts[self.first[row + 1]] - self.received[row + 1] > self.tolerance:
                return 0
            count = self.last[row] - self.first[row] + 1
            if count != 1:
                return 0 if count else distance
        return 0

    def _forward(self, k: int) -> int:
        """The distance of the joint state after k that has no effort; 0 if there is none."""
        for distance in range(1, min(LONGEST_EXCHANGE, len(self.received) - 1 - k) + 1):
            row = k + distance
            if self.received[row] - self.efforts[self.last[row - 1]] > self.tolerance:
                return 0
            count = self.last[row] - self.first[row] + 1
            if count != 1:
                return 0 if count else distance
        return 0


def _selected(t: np.ndarray, start: float, duration: float | None, path: Path) -> slice:
    """The rows from `start` on, until the first one that is `duration` later; ValueError for times
    that decrease among them.
    """
    begun = np.flatnonzero(t >= start - RESOLUTION)
    first = int(begun[0]) if len(begun) else len(t)
    end = len(t)
    if duration is not None:
        late = np.flatnonzero(t[first:] - start >= duration - RESOLUTION)
        end = first + int(late[0]) if len(late) else end
    if end == first:
        length = "all" if duration is None else f"{duration:g} s"
        came = checks.Words(f"no joint state in {length} from {start:g} s on")
        expected = f"a part of the times from {t.min():.9g} to {t.max():.9g} s"
        raise checks.fail(str(path), came, expected, "Set start, duration or time_origin.")
    backward = np.flatnonzero(np.diff(t[first:end]) <= 0)
    if not len(backward):
        return slice(first, end)
    k = first + int(backward[0])
    came = checks.Words(f"{t[k]:.9g} s and then {t[k + 1]:.9g} s, the joint states {k} and {k + 1}")
    remedy = f"duration={t[k] - start:.9g} selects the part before."
    if t[k] <= start:
        remedy = 'times="receive" uses the times at which the recorder received them.'
    raise checks.fail(f"{path}: stamps", came, "times that increase", remedy)


# --- options -------------------------------------------------------------------------------------


def _requested_names(
    n: int, joints: Sequence[str], chosen: Sequence[str] | None
) -> tuple[str, ...]:
    """The names of the n joints in the messages; () if neither user nor scenario has names."""
    if chosen is None:
        return tuple(joints) if len(joints) == n else ()
    expected = f"a list of {n} different names, in the order of the scenario's joints"
    if isinstance(chosen, str) or not isinstance(chosen, Sequence):
        raise checks.fail("joints", chosen, expected)
    is_complete = len(chosen) == n and all(isinstance(x, str) for x in chosen)
    if not is_complete or len(set(chosen)) != n:
        raise checks.fail("joints", chosen, expected)
    return tuple(chosen)


# --- messages ------------------------------------------------------------------------------------


def _recording(path: Path, names: tuple[str, ...], n: int, options: BagOptions) -> Recording:
    """The messages of the two topics, checked."""
    states = _StateReader(path, names, n, options)
    efforts = _EffortReader(path, n)
    for is_state, received, message in _messages(path, options):
        if is_state:
            states.add(received, message)
        else:
            efforts.add(received, message)
    if options.efforts is None:
        efforts.received, efforts.rows = states.received, states.efforts
    return states.recording(efforts)


def _messages(path: Path, options: BagOptions) -> Iterator[tuple[bool, int, Any]]:
    """Whether a message is a joint state, its receive time [ns], and the message, in order."""
    library, typesys = _library()
    _check_is_bag(path)
    _check_lengths(path)
    store = typesys.get_typestore(typesys.Stores.LATEST)
    with contextlib.ExitStack() as stack:
        with _damage_reported(path):
            reader = stack.enter_context(library.Reader(path))
            topics = {name: topic.msgtype for name, topic in reader.topics.items()}
        read = {_topic("joint_states", options.joint_states, STATE_TYPE, topics, path): STATE_TYPE}
        if options.efforts is not None:
            read[_topic("efforts", options.efforts, EFFORT_TYPE, topics, path)] = EFFORT_TYPE
        connections = [x for x in reader.connections if x.topic in read]
        missing = sum(x.msgcount for x in connections)
        with _damage_reported(path):
            for connection, received, raw in reader.messages(connections=connections):
                missing -= 1
                message_type = read[connection.topic]
                message = store.deserialize_cdr(raw, message_type)
                yield message_type == STATE_TYPE, received, message
    if missing > 0:
        raise _damaged(path, f"{missing} messages less than its metadata count")


def _library() -> tuple[Any, Any]:
    """The modules of `rosbags`; ImportError with a remedy if it is not installed."""
    try:
        from rosbags import rosbag2, typesys
    except ImportError as error:
        raise ImportError(
            "A rosbag2 recording needs the rosbags package: pip install rosbags, or"
            ' ".[ros]" in a clone.'
        ) from error
    return rosbag2, typesys


def _check_is_bag(path: Path) -> None:
    """Raises ValueError for a folder that is no complete recording."""
    if not path.is_dir() or (path / "metadata.yaml").exists():
        return
    stored = sorted(x.name for x in path.iterdir() if x.suffix in STORAGE_ENDINGS)
    came = checks.Words("a folder without metadata.yaml")
    remedy = "A log is such a folder, or a file that ends in .csv or .nc."
    if stored:
        remedy = f"Run ros2 bag reindex {path}, or read the file {stored[0]} in it."
    raise checks.fail(str(path), came, "the folder of a rosbag2 recording", remedy)


def _check_lengths(path: Path) -> None:
    """Raises ValueError for a database that is shorter than its own header says.

    SQLite reads what is missing of the last page as zeros, and depending on its version and on what
    was there, no message looks damaged.
    """
    files = sorted(path.glob("*.db3")) if path.is_dir() else [path]
    for file in files:
        with file.open("rb") as opened:
            header = opened.read(100)
        # The number of pages is valid if the counters at 24 and 92 are equal.
        if not header.startswith(b"SQLite format 3\0") or header[24:28] != header[92:96]:
            continue
        page_size = int.from_bytes(header[16:18], "big")
        if page_size == 1:
            page_size = 65536
        expected = page_size * int.from_bytes(header[28:32], "big")
        size = file.stat().st_size
        if size < expected:
            raise _damaged(path, f"{size} bytes of {file.name}, which had {expected}")


@contextlib.contextmanager
def _damage_reported(path: Path) -> Iterator[None]:
    """Turns the errors of a damaged recording, which are of many kinds, into a ValueError."""
    try:
        yield
    except OSError:
        raise
    except Exception as error:
        raise _damaged(path, str(error) or type(error).__name__) from error


def _damaged(path: Path, reason: str) -> ValueError:
    """The error about a damaged recording."""
    remedy = "If the recording was interrupted, run ros2 bag reindex, or mcap recover."
    return checks.fail(str(path), checks.Words(reason), "a complete rosbag2 recording", remedy)


def _topic(
    field: str, name: str, message_type: str, topics: dict[str, str | None], path: Path
) -> str:
    """The name in the recording of a topic: an absolute name, or the end of exactly one name."""
    absolute = f"/{name.lstrip('/')}"
    found = [x for x in topics if x == absolute]
    if not found and not name.startswith("/"):
        found = [x for x in topics if x.endswith(absolute)]
    listed = ", ".join(f"{key} ({value})" for key, value in sorted(topics.items())) or "none"
    if len(found) != 1:
        came = checks.Words(f"{len(found) or 'no'} topics {name}")
        remedy = f'Give its name: ij.deployment.bag_log(path, scenario, {field}="/name").'
        if field == "efforts":
            remedy += " efforts=None reads the efforts in the joint states."
        raise checks.fail(f"{path}: {field}", came, f"one of the topics: {listed}", remedy)
    if topics[found[0]] != message_type:
        came = checks.Words(f"{found[0]} with messages {topics[found[0]]}")
        raise checks.fail(f"{path}: {field}", came, message_type, f"The topics are: {listed}.")
    return found[0]


class _StateReader:
    """Collects joint states in the order of the scenario's joints."""

    def __init__(self, path: Path, names: tuple[str, ...], n: int, options: BagOptions) -> None:
        self.path = path
        self.names = names
        self.n = n
        self.has_efforts = options.efforts is None
        """Whether the efforts in the joint states are read."""
        self.has_stamps = options.times == "stamp"
        self.places: dict[tuple[str, ...], list[int] | None] = {}
        """Names in a message -> the entries of the joints; None for another robot's message."""
        self.stamp: list[int] = []
        self.received: list[int] = []
        self.q: list[np.ndarray] = []
        self.dq: list[np.ndarray | None] = []
        self.efforts: list[np.ndarray] = []

    def fail(self, came: str, expected: str, remedy: str = "") -> ValueError:
        """The error about a joint state."""
        field = f"{self.path}: joint state {len(self.stamp)}"
        return checks.fail(field, checks.Words(came), expected, remedy)

    def add(self, received: int, message: Any) -> None:
        """Adds a message; one without any of the joints is left out."""
        key = tuple(message.name)
        if key not in self.places:
            self.places[key] = self._entries(key)
        places = self.places[key]
        if places is None:
            return
        stamp = received
        if self.has_stamps:
            stamp = message.header.stamp.sec * NANOSECONDS + message.header.stamp.nanosec
        q = self._values("position", message.position, key, places)
        is_first = not self.has_stamps or not self.stamp
        if not is_first and stamp == self.stamp[-1] and np.array_equal(q, self.q[-1]):
            return  # the state before is published again
        dq = None
        if len(message.velocity):
            dq = self._values("velocity", message.velocity, key, places)
        if self.has_efforts:
            self.efforts.append(self._values("effort", message.effort, key, places))
        self.stamp.append(stamp)
        self.received.append(received)
        self.q.append(q)
        self.dq.append(dq)

    def _entries(self, key: tuple[str, ...]) -> list[int] | None:
        """The entries of the scenario's joints in messages with these names."""
        if len(set(key)) < len(key):
            raise self.fail(f"the names {', '.join(key)}", "different names")
        if not self.names:
            self.names = self._names_of_message(key)
        missing = [name for name in self.names if name not in key]
        if len(missing) == self.n:
            return None
        if missing:
            came = f"the joints {', '.join(key)}"
            raise self.fail(came, f"all of {', '.join(self.names)}", NAMES_REMEDY)
        return [key.index(name) for name in self.names]

    def _names_of_message(self, key: tuple[str, ...]) -> tuple[str, ...]:
        """The names of the joints of a robot without names: those of an exported node if they are
        in the first message, else all names of this message.
        """
        exported = tuple(f"joint_{i + 1}" for i in range(self.n))
        if set(exported) <= set(key):
            return exported
        if len(key) != self.n:
            came = f"the joints {', '.join(key)}"
            expected = f"{self.n} joints, as the scenario's robot has no names"
            raise self.fail(came, expected, NAMES_REMEDY)
        notices.warn(
            f"{self.path}: the scenario's robot has no joint names; the joints are read in the"
            f" order of the first message: {', '.join(key)}. {NAMES_REMEDY}"
        )
        return key

    def _values(
        self, what: str, values: np.ndarray, key: tuple[str, ...], places: list[int]
    ) -> np.ndarray:
        """A field of a message in the order of the scenario's joints, (n,)."""
        if len(values) != len(key):
            came = f"{len(values)} numbers as {what}"
            raise self.fail(came, f"{len(key)}, one for each name: {', '.join(key)}")
        return np.asarray(values, float)[places]

    def recording(self, efforts: _EffortReader) -> Recording:
        """All messages as arrays."""
        if not self.stamp:
            came = "no joint states"
            if self.places:
                came = "joint states of " + "; ".join(", ".join(key) for key in self.places)
            expected = f"joint states of {', '.join(self.names) or f'{self.n} joints'}"
            raise checks.fail(f"{self.path}: joints", checks.Words(came), expected, NAMES_REMEDY)
        dq = None
        velocities = [x for x in self.dq if x is not None]
        if len(velocities) == len(self.dq):
            dq = np.array(velocities)
        return Recording(
            np.array(self.stamp, np.int64),
            np.array(self.received, np.int64),
            np.array(self.q),
            dq,
            np.array(efforts.received, np.int64),
            np.array(efforts.rows).reshape(-1, self.n),
        )


class _EffortReader:
    """Collects efforts."""

    def __init__(self, path: Path, n: int) -> None:
        self.path = path
        self.n = n
        self.received: list[int] = []
        self.rows: list[np.ndarray] = []

    def add(self, received: int, message: Any) -> None:
        """Adds a message."""
        if len(message.data) != self.n:
            field = f"{self.path}: effort {len(self.rows)}"
            came = checks.Words(f"{len(message.data)} numbers")
            raise checks.fail(field, came, f"{self.n}, one for each joint of the scenario")
        self.received.append(received)
        self.rows.append(np.asarray(message.data, float))
