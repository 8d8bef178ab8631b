"""Which word somebody meant."""

import difflib
from collections.abc import Iterable


def meant(word: object, known: Iterable[str]) -> str:
    """What to add to a message about a word that is not known: a question, or nothing if no known word is like it.

    **Arguments:**

    - `word`: as it was written. `known`: words that would do, upper or lower case.
    """
    by_form = {each.lower(): each for each in known}
    form = word.strip().lower() if isinstance(word, str) else ""
    # A short word that shares most of its letters with another often means something else: SAC is not SMC.
    near = difflib.get_close_matches(form, by_form, n=1, cutoff=0.6 if len(form) > 3 else 0.7)
    return f" Did you mean {by_form[near[0]]!r}?" if near else ""
