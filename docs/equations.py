"""The equations of docstrings, which are written for terminals, in TeX for the site's pages."""

from __future__ import annotations

import re
from collections.abc import Iterable

LETTERS = "alpha beta gamma Gamma delta Delta eta theta kappa lambda mu xi pi Phi phi rho sigma tau"
OPERATORS = "sin cos tan exp log ln det min max sum int"
SYMBOLS = {name: rf"\{name} " for name in f"{LETTERS} {OPERATORS}".split()} | {
    "eps": r"\varepsilon ",
    "d": r"\mathrm{d}",
}
SYMBOLS |= {name: rf"{name[0]}_{{{name[1]}}}" for name in ("kf", "kc", "Kp", "Kd")}
ACCENTS = {"hat": r"\hat", "tilde": r"\tilde"}
SIGNS = {
    "<=": r"\le ",
    ">=": r"\ge ",
    "->": r"\to ",
    "!=": r"\ne ",
    "...": r"\dots ",
    "+-": r"\pm ",
    "-+": r"\mp ",
}
SIGNS |= {"{": r"\{", "}": r"\}", "~": r"\sim ", "*": r"\cdot ", '"': r'\text{"}', "`": ""}
TAG = re.compile(r"\(\d\.\d+\)(?:[-,]\s*\(\d\.\d+\))*")
TOKENS = re.compile(
    rf"(?P<tag>{TAG.pattern})|(?P<gap>\s{{3,}})|"
    r"(?P<space>\s+)|(?P<sign><=|>=|->|!=|\.\.\.|\+-|-\+)"
    r"|(?P<name>[A-Za-z]+)(?P<index>\d*)(?P<sub>(?:_(?:\w+_\+|~?\w+|\([^)]*\)|\{[^}]*\}))?)(?P<prime>['\"]*)"
    r"|(?P<power>\^(?:-?\d|[A-Za-z]+\d*|\((?:[^()]|\([^()]*\))*\)))|(?P<other>.)"
)


def block(lines: Iterable[str]) -> str:
    """Lines of a docstring as one displayed equation in Markdown."""
    return (
        "$$\n\\begin{array}{l}\n"
        + " \\\\\n".join(tex(line.strip()) for line in lines if line.strip())
        + "\n\\end{array}\n$$\n"
    )


def tex(text: str) -> str:
    """One line in TeX.  A name of several letters that is no symbol is a word, or a function where
    its argument follows.
    """
    parts = list[tuple[str, str]]()
    for found in TOKENS.finditer(text):
        token = found[0]
        if found["name"]:
            parts.append(
                _name(
                    found["name"],
                    found["index"],
                    found["sub"][1:],
                    found["prime"],
                    token,
                    text[found.end() :],
                )
            )
        elif found["tag"]:
            parts.append(("sign", rf"\quad\text{{{token}}}"))
        elif found["gap"]:
            parts.append(("sign", "" if TAG.match(text, found.end()) else " \\\\\n"))
        elif found["space"]:
            parts.append(("space", " "))
        elif found["power"]:
            inner = token[1:]
            parts.append(("sign", f"^{{{tex(inner[1:-1] if inner.startswith('(') else inner)}}}"))
        else:
            parts.append(("sign", SIGNS.get(token, token)))
    return _joined(parts)


def _joined(parts: list[tuple[str, str]]) -> str:
    """The parts in a row, with the spaces that TeX would leave out: about words, and a small one
    where two symbols are multiplied.
    """
    kinds = ["", *(kind for kind, _ in parts), ""]
    out = ""
    for before, (kind, text), after in zip(kinds, parts, kinds[2:], strict=False):
        if kind == "word":
            out += rf"\text{{{text}}}"
        elif kind == "space":
            out += (
                r"\ " if "word" in (before, after) else r"\," if before == after == "name" else " "
            )
        else:
            out += text
    return out


def _name(
    name: str, index: str, sub: str, prime: str, token: str, following: str
) -> tuple[str, str]:
    """A symbol with its index, its subscript and its primes, or a word."""
    prime = prime.replace('"', "''")
    if name == "a" and re.match(" [a-z]{3}", following):
        return "word", name
    if len(name) == 1 or name in SYMBOLS:
        symbol = SYMBOLS.get(name, name)
        accent, _, below = sub.partition("_")
        if accent in ACCENTS:
            lower = _lower(",".join(part for part in (index, _subscript(below)) if part))
            return "name", f"{ACCENTS[accent]}{{{symbol.strip()}}}{lower}{prime}"
        return (
            "name",
            f"{symbol}{_lower(','.join(part for part in (index, _subscript(sub)) if part))}{prime}",
        )
    if name[0] == "d" and (len(name) == 2 or name[1:] in SYMBOLS):
        kind, rest = _name(name[1:], index, sub, prime, token[1:], following)
        return kind, rf"\mathrm{{d}} {rest}"
    word = token.rstrip("'\"")
    if following.startswith(("(", "|")):
        return "name", rf"\operatorname{{{word}}}{prime}".replace("_", r"\_")
    if 0 < len(sub) < 3:
        return "name", rf"\text{{{name}}}{_lower(sub)}{prime}"
    return "word", (word + prime).replace("_", r"\_")


def _subscript(sub: str) -> str:
    sub = sub[1:-1] if sub[:1] in ("(", "{") else sub.replace("~", r"\sim ")
    return sub if len(sub) < 3 or not sub.isalpha() else rf"\text{{{sub}}}"


def _lower(text: str) -> str:
    return f"_{{{text}}}" if text else ""
