"""Calls that must be refused."""

from collections.abc import Callable
from typing import Any

import pytest


def assert_refused(
    words: str,
    call: Callable[..., Any],
    *arguments: Any,
    error: type[BaseException] = ValueError,
    **options: Any,
) -> None:
    """Fails unless a call raises this error with a message that matches the words."""
    with pytest.raises(error, match=words):
        call(*arguments, **options)


def refused(*rows: tuple[Callable[[], Any], str]) -> Callable[..., None]:
    """A test of rows (call, words), each of which must be refused with its words."""

    @pytest.mark.parametrize(("call", "words"), rows)
    def test(call: Callable[[], Any], words: str) -> None:
        assert_refused(words, call)

    return test
