"""Which word somebody meant."""

import difflib
from collections.abc import Iterable


def meant(word: object, known: Iterable[str]) -> str:
    """What to add to a message about a word that is not known: a question, or nothing if no known word is like it.

    **Arguments:**

    - `word`: as it was written. `known`: words that would do, upper or lower case.
    """
    by_form = {each.lower(): each for each in known}
    near = difflib.get_close_matches(word.strip().lower(), by_form, n=1) if isinstance(word, str) else []
    return f" Did you mean {by_form[near[0]]!r}?" if near else ""
