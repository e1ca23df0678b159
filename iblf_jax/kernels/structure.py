"""The rules of the primitives that only rearrange numbers: they are applied to node numbers.

An index that is unknown at compile time (the piece of a spline at time t) becomes a selection among
the possible entries, or a lookup if all of these are constants.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import numpy as np

from iblf_jax.kernels.program import Builder, Ids, UnsupportedError, constants


def _broadcast_in_dim(b: Builder, eqn, x: Ids, *_: Ids) -> Ids:
    shape, dimensions = eqn.params["shape"], eqn.params["broadcast_dimensions"]
    spread = [1] * len(shape)
    for axis, place in enumerate(dimensions):
        spread[place] = x.shape[axis]
    return np.broadcast_to(x.reshape(spread), shape)


def _slice(b: Builder, eqn, x: Ids) -> Ids:
    p = eqn.params
    strides = p["strides"] or (1,) * x.ndim
    return x[
        tuple(
            slice(lo, hi, s)
            for lo, hi, s in zip(p["start_indices"], p["limit_indices"], strides, strict=True)
        )
    ]


def _split(b: Builder, eqn, x: Ids):
    return np.split(x, np.cumsum(eqn.params["sizes"])[:-1], axis=eqn.params["axis"])


def _pad(b: Builder, eqn, x: Ids, filler: Ids) -> Ids:
    for axis, (low, high, interior) in enumerate(eqn.params["padding_config"]):
        size = x.shape[axis] + max(x.shape[axis] - 1, 0) * interior
        shape = list(x.shape)
        shape[axis] = size + max(low, 0) + max(high, 0)
        padded = np.full(shape, int(filler))
        where = [slice(None)] * x.ndim
        where[axis] = slice(max(low, 0), max(low, 0) + size, interior + 1)
        padded[tuple(where)] = x
        where[axis] = slice(max(-low, 0), shape[axis] - max(-high, 0))
        x = padded[tuple(where)]
    return x


def _iota(b: Builder, eqn, *_: Ids) -> Ids:
    shape, axis = eqn.params["shape"], eqn.params["dimension"]
    line = np.arange(shape[axis]).reshape([-1 if i == axis else 1 for i in range(len(shape))])
    return constants(b, np.broadcast_to(line, shape).astype(eqn.outvars[0].aval.dtype))


def _empty(b: Builder, eqn, *_: Ids) -> Ids:
    """An array that other primitives fill before it is read."""
    return constants(b, np.zeros(eqn.outvars[0].aval.shape, eqn.outvars[0].aval.dtype))


def _chosen(
    b: Builder, x: Ids, index: Ids, at: Callable, known: dict[int, int] | None = None
) -> Ids:
    """The entries of x at an index; a selection among the values 0 ... longest axis - 1 of each
    number of the index that is unknown.

    Args:
      b: the builder.
      x: the nodes among which the index selects.
      index: nodes of the index.
      at: function (values of the index) -> nodes.
      known: node of the index -> value that is assumed.
    """
    known = known or {}
    size = max(x.shape, default=1)
    nodes = index.ravel().tolist()
    values = [known.get(i, b.value(i)) for i in nodes]
    unknown = [i for i, value in zip(nodes, values, strict=True) if value is None]
    if not unknown:
        return at(np.asarray(values, np.int32).reshape(index.shape))
    choices = size ** len({*unknown, *known})
    limit = b.limits.choices
    if choices == size and _is_table(b, x.ravel().tolist()):
        limit = b.limits.table
    if choices > limit:
        raise UnsupportedError(
            f"indices that only the run knows choose among {choices} entries, which is too many"
        )
    node = unknown[0]
    cases = [_chosen(b, x, index, at, known | {node: v}) for v in range(size)]
    columns = np.stack([case.ravel() for case in cases], axis=1)
    if columns.size > b.limits.tables:
        raise UnsupportedError(
            f"an index that only the run knows chooses among {columns.size} numbers, which is too"
            " many"
        )
    return np.asarray([_one_of(b, column, node) for column in columns.tolist()], np.int64).reshape(
        cases[0].shape
    )


def _is_table(b: Builder, entries: list[int]) -> bool:
    """Whether all entries are floating-point constants."""
    return all(b.value(i) is not None and b.nodes[i].kind == "f" for i in entries)


def _one_of(b: Builder, entries: list[int], index: int) -> int:
    """The entry at an unknown index: a lookup if all are constants, else a selection."""
    if len(set(entries)) == 1:
        return entries[0]
    if _is_table(b, entries):
        return b.lookup(tuple(b.value(i) for i in entries), index)
    if len(entries) > b.limits.choices:
        raise UnsupportedError(
            f"an index that only the run knows chooses among {len(entries)} entries, which is too"
            " many"
        )
    result = entries[-1]
    for v, entry in reversed(list(enumerate(entries[:-1]))):
        result = b.emit(
            "select",
            b.emit("le", index, b.constant(v, "i"), kind="b"),
            entry,
            result,
            kind=b.nodes[entry].kind,
        )
    return result


def _gather(b: Builder, eqn, x: Ids, index: Ids) -> Ids:
    """Entries of x, the nearest one for an index outside.

    A gather that fills entries outside with a given number is refused.
    """
    if eqn.params["mode"] == jax.lax.GatherScatterMode.FILL_OR_DROP:
        starts = eqn.params["dimension_numbers"].start_index_map
        sizes = eqn.params["slice_sizes"]
        places = [[b.value(i) for i in row] for row in index.reshape(-1, len(starts)).tolist()]
        if not all(
            v is not None and 0 <= v <= x.shape[a] - sizes[a]
            for place in places
            for a, v in zip(starts, place, strict=True)
        ):
            raise UnsupportedError("a gather that fills what lies outside; index with mode='clip'")

    def at(values):
        params = dict(eqn.params, fill_value=None, mode=jax.lax.GatherScatterMode.CLIP)
        with jax.ensure_compile_time_eval():
            return np.asarray(
                eqn.primitive.bind(
                    jax.numpy.asarray(x, np.int32), jax.numpy.asarray(values), **params
                ),
                np.int64,
            )

    rows = list(np.ndindex(index.shape[:-1]))
    if len(rows) == 1 or all(b.value(i) is not None for i in index.ravel().tolist()):
        return _chosen(b, x, index, at)
    # One place after the other, so that each is selected by its own index only.
    result = np.empty(eqn.outvars[0].aval.shape, np.int64)
    offsets = eqn.params["dimension_numbers"].offset_dims
    axes = [a for a in range(result.ndim) if a not in offsets]
    for row in rows:
        here = np.full(index.shape, b.constant(0, "i"))
        here[row] = index[row]
        one = np.moveaxis(_chosen(b, x, here, at), axes, range(len(axes)))[row]
        np.moveaxis(result, axes, range(len(axes)))[row] = one
    return result


def _window(starts, shape: Sequence[int], sizes: Sequence[int]) -> tuple[slice, ...]:
    """The slices of a window of these sizes, moved inside the shape where it exceeds it."""
    corner = [
        min(max(int(start), 0), length - size)
        for start, length, size in zip(starts, shape, sizes, strict=True)
    ]
    return tuple(slice(first, first + size) for first, size in zip(corner, sizes, strict=True))


def _dynamic_slice(b: Builder, eqn, x: Ids, *starts: Ids) -> Ids:
    def at(values):
        return x[_window(values, x.shape, eqn.params["slice_sizes"])]

    return _chosen(b, x, np.asarray(starts), at)


def _dynamic_update_slice(b: Builder, eqn, x: Ids, new: Ids, *starts: Ids) -> Ids:
    def at(values):
        result = x.copy()
        result[_window(values, x.shape, new.shape)] = new
        return result

    return _chosen(b, x, np.asarray(starts), at)


def _scatter(op: str | None) -> Callable:
    """The rule of a scatter at known places, which combines old and new numbers by `op`.

    The numbers of the updates are scattered, which shows the place of each update.
    """

    def rule(b: Builder, eqn, x: Ids, index: Ids, new: Ids) -> Ids:
        values = [b.value(i) for i in index.ravel().tolist()]
        if any(v is None for v in values):
            raise UnsupportedError(f"{eqn.primitive.name} at an index that only the run knows")
        places = np.asarray(values, np.int32).reshape(index.shape)
        with jax.ensure_compile_time_eval():
            numbers = jax.numpy.arange(new.size, dtype=np.int32).reshape(new.shape)
            params = {
                k: eqn.params[k] for k in eqn.params if k not in ("update_jaxpr", "update_consts")
            }
            landed = jax.lax.scatter(
                jax.numpy.full(x.shape, -1, np.int32), places, numbers, **params
            )
        source = np.asarray(landed)
        if np.sum(source >= 0) != new.size:
            raise UnsupportedError(f"{eqn.primitive.name} with repeated or outlying places")
        result = x.copy().ravel()
        updates = new.ravel()
        for place, which in enumerate(source.ravel().tolist()):
            if which < 0:
                continue
            update = int(updates[which])
            if op is not None:
                old = int(result[place])
                update = b.emit(op, old, update, kind=b.nodes[old].kind)
            result[place] = update
        return result.reshape(x.shape)

    return rule


STRUCTURE: dict[str, Callable] = {
    **dict.fromkeys(
        ("reshape", "squeeze", "expand_dims"),
        lambda b, eqn, x, *_: x.reshape(eqn.outvars[0].aval.shape),
    ),
    "broadcast_in_dim": _broadcast_in_dim,
    "transpose": lambda b, eqn, x: np.transpose(x, eqn.params["permutation"]),
    "slice": _slice,
    "concatenate": lambda b, eqn, *xs: np.concatenate(xs, axis=eqn.params["dimension"]),
    "stack": lambda b, eqn, *xs: np.stack(
        xs, axis=eqn.params.get("axis", eqn.params.get("dimension", 0))
    ),
    "split": _split,
    "rev": lambda b, eqn, x: np.flip(x, eqn.params["dimensions"]),
    "pad": _pad,
    "iota": _iota,
    **dict.fromkeys(("empty", "empty2"), _empty),  # of the transpose of a scan
    # Since jax 0.11.
    "unstack": lambda b, eqn, x: list(np.moveaxis(x, eqn.params["axis"], 0)),
    "gather": _gather,
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update_slice,
    "scatter": _scatter(None),
    **dict.fromkeys(("scatter-add", "scatter_add"), _scatter("add")),
    **dict.fromkeys(("scatter_mul", "scatter-mul"), _scatter("mul")),
}
