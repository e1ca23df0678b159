"""Works that are often cited and have no entry of their own, because neither a text with all
parameters nor a program of the authors could be read; the page of the benchmark lists them.

A work leaves the list when an entry is made from its text or from a program of its authors.
"""

from __future__ import annotations

from typing import NamedTuple


class Work(NamedTuple):
    """A work, and the entries that are nearest to it."""

    reference: str
    entries: tuple[str, ...] = ()
    """Made from a program or a text of others that follows it, or of the same method."""
    found: str = "neither a text nor a program of the authors"
    """What the search found."""


SEARCHED = "2026-12-01"
"""Date of the search in public pages and repositories."""
NOT_READABLE = (
    Work("K. P. Tee, S. S. Ge, E. H. Tay, Automatica 45 (2009) 918-927", ("liu_2018",)),
    Work(
        "K. P. Tee, B. Ren, S. S. Ge, Automatica 47 (2011) 2511-2516",
        ("zhang_yan_2024",),
        "the beginning of the text, without the example",
    ),
    Work(
        "C. P. Bechlioulis, G. A. Rovithakis, IEEE Trans. Automatic Control 53 (2008) 2090-2099",
        ("dimanidis_2018",),
        "a thesis with its arm and reference, and a program of others that identifies an arm with"
        " its law",
    ),
    Work(
        "C. P. Bechlioulis, G. A. Rovithakis, Automatica 50 (2014) 1217-1226",
        ("dimanidis_2018", "damodaran_2024"),
        "the beginning of the text of a conference version, without the example",
    ),
    Work(
        "A. Ilchmann, E. P. Ryan, C. J. Sangwin, ESAIM COCV 7 (2002) 471-493 (funnel control)",
        ("dennstaedt_2026", "dennstaedt_sampled_2026"),
    ),
    Work(
        "T. Berger, A.-L. Rauert, arXiv:1907.04120 (funnel cruise control)",
        ("dennstaedt_2026", "autenrieb_2023"),
        "the beginning of the text, without the example",
    ),
    Work("W. He, Y. Chen, Z. Yin, IEEE Trans. Cybernetics 46 (2016) 620-629"),
    Work("Y. J. Liu, S. Lu, S. Tong, IEEE Trans. Syst. Man Cybern. Syst. 47 (2017) 2060-2068"),
    Work(
        "A. D. Ames, X. Xu, J. W. Grizzle, P. Tabuada, IEEE Trans. Automatic Control 62 (2017)"
        " 3861-3876",
        ("autenrieb_2023", "choi_2023"),
        "the beginning of arXiv:1609.06408, without the parameters",
    ),
    Work(
        "Q. Nguyen, K. Sreenath, American Control Conference (2016) 322-328",
        ("choi_2024",),
        "a link to the text, which could not be opened",
    ),
    Work(
        "M. M. Nicotra, E. Garone, IEEE Control Systems Magazine 38 (2018) 89-107 (explicit"
        " reference governor), and its examples of robot arms",
        ("bemporad_2003",),
    ),
)
