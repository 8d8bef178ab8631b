"""Suggestions for misspelt words."""

import difflib
from collections.abc import Iterable


def did_you_mean(word: object, known: Iterable[str]) -> str:
    """Return a question to append to a message about an unknown word; empty if no known word is similar.

    **Arguments:**

    - `word`: as the user wrote it. `known`: allowed words, in upper or lower case.
    """
    by_form = {each.lower(): each for each in known}
    form = word.strip().lower() if isinstance(word, str) else ""
    # A short word that shares most of its letters with another often means something else: SAC is not SMC.
    near = difflib.get_close_matches(form, by_form, n=1, cutoff=0.6 if len(form) > 3 else 0.7)
    return f" Did you mean {by_form[near[0]]!r}?" if near else ""
