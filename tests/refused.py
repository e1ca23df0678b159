"""Calls that must be refused."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest


def assert_refused(words: str, call: Callable[..., Any], *arguments: Any, **options: Any) -> None:
    """Fails unless a call raises a ValueError whose message matches the words."""
    with pytest.raises(ValueError, match=words):
        call(*arguments, **options)


def refused(*rows: tuple[Callable[[], Any], str]) -> Callable[..., None]:
    """A test of rows (call, words), each of which must be refused with its words."""

    @pytest.mark.parametrize(("call", "words"), rows)
    def test(call: Callable[[], Any], words: str) -> None:
        assert_refused(words, call)

    return test
