"""Reads a task of the benchmark of the field and evaluates its functions, with NumPy alone.

    task = read("liu_2018.json")
    rates(task, t, x, u)                        # x' with the disturbance, for any solver
    evaluate(task, "reference", t)              # the reference and its derivatives

t is () or (T,), x is (..., states), u is (..., inputs); README.md describes the format.
"""

import json

import numpy as np

# fmt: off
OPERATIONS = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "neg": np.negative,
    "abs": np.abs, "sign": np.sign, "sqrt": np.sqrt, "pow": np.power, "floor": np.floor,
    "truncate": np.trunc, "rem": np.fmod, "min": np.minimum, "max": np.maximum,
    "select": np.where, "sin": np.sin, "cos": np.cos, "tan": np.tan, "asin": np.arcsin,
    "acos": np.arccos, "atan": np.arctan, "atan2": np.arctan2, "sinh": np.sinh, "cosh": np.cosh,
    "tanh": np.tanh, "exp": np.exp, "expm1": np.expm1, "log": np.log, "log1p": np.log1p,
    "lt": np.less, "le": np.less_equal, "gt": np.greater, "ge": np.greater_equal,
    "eq": np.equal, "ne": np.not_equal,
}
# fmt: on


def read(path):
    """The contents of a task file."""
    with open(path, encoding="utf-8") as file:
        return json.load(file)


def evaluate(task, name, *arguments):
    """The results of a function, (..., results), of its arguments t, x, u, w as far as it has
    them.
    """
    function = task["functions"][name]
    v = []
    for kind, value in zip(function["arguments"], arguments, strict=True):
        value = np.asarray(value, float)
        v += [value] if kind == "t" else [value[..., i] for i in range(value.shape[-1])]
    with np.errstate(all="ignore"):
        for op, *args in function["program"]:
            if op == "const":
                v.append(np.float64(args[0]))
            elif op == "lookup":
                place = np.clip(np.asarray(v[args[0]], int), 0, len(args[1]) - 1)
                v.append(np.array(args[1])[place])
            else:
                v.append(np.asarray(OPERATIONS[op](*(v[i] for i in args)), float))
    shape = np.broadcast_shapes(*(np.shape(value) for value in v))
    rows = [np.broadcast_to(v[i], shape) for i in function["results"]]
    return np.stack(rows, axis=-1) if rows else np.zeros((*shape, 0))


def rates(task, t, x, u):
    """The rate of the state with the disturbance, (..., states)."""
    return evaluate(task, "rates", t, x, u, evaluate(task, "disturbance", t, x))
